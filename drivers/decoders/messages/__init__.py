"""Decoders of messages that a transport delivers whole, such as zenoh messages."""
