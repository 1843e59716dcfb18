"""Messages published over zenoh, and JSON output of commands."""
