"""Worker thread, processing pipeline and status of a device."""
