"""Display of results in the Rerun viewer."""
