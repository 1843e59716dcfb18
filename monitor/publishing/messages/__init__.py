"""Encoding and decoding of the messages that are sent over zenoh."""
