"""Long-term history of the results in one file: rows of one minute, which are merged into wider rows later."""
