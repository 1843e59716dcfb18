"""HTML reports, Rerun recordings and tables of results."""
