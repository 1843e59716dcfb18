"""One device of the daemon: its worker thread, processing pipeline and status."""
