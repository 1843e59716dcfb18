"""Worker processes among which the daemon spreads its devices, and their supervisor."""
