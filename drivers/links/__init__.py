"""Links: each module receives bytes over one kind of transport. ``base`` defines the interface."""
