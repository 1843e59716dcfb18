"""Modules that all packages of the monitor share."""
