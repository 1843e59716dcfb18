"""Messages that the daemon publishes over zenoh, and the JSON output of commands."""
