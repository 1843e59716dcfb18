"""HTML reports, Rerun files and tables of results."""
