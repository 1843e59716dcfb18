"""Results written to files as HTML reports, Rerun recordings and tables."""
