"""Recorder of the service, and retention of its recordings."""
