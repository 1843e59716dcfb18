"""Exchange of results over zenoh: the publisher of the daemon, a subscriber, and history queries."""
