"""Long-term history: results aggregated per minute, kept in one file, merged with age without loss of extremes."""
