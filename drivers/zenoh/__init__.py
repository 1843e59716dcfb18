"""Configuration of zenoh sessions, diagnosis of connection errors, and the message format of samples."""
