"""Long-term history of the results. Rows of one minute are merged into wider rows later."""
