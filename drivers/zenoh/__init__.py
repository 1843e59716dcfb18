"""zenoh sessions, connection errors and the sample message."""
