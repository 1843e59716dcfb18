"""Access to this machine: files, installed packages, and the layout of IIO buffers."""
