"""Output of results: zenoh, the Rerun viewer, the terminal, plots, reports and parameter files."""
