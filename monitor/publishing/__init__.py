"""Publish results over zenoh, show them in Rerun and in the terminal, and write plots, reports and files."""
