"""Recordings that the service writes, and how long they are kept."""
