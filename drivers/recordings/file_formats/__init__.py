"""Readers and writers of the file formats of recordings, one module for each format."""
