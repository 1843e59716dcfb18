"""Where results leave the process: zenoh, Rerun, the terminal, plots."""
