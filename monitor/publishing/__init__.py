"""Output of results over zenoh, in Rerun and in the terminal, and as plots, reports and parameter files."""
