"""Results of years: gathered by the minute, kept in one file, thinned with age without losing extremes."""
