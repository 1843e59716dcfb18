"""Outputs of the daemon: zenoh messages, viewer, log lines, table in the terminal, and history."""
