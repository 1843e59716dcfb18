"""A file a room: what its readers are tried with, and what must hold of what comes out."""
