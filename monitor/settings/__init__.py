"""Reading and validation of configuration files."""
