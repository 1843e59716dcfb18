"""Configuration files: keys, conversion of values, and all errors of a file."""
