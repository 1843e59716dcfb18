"""Effects that add a constant or variable bias."""
