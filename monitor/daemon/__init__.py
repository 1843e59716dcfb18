"""Service process: device workers, processing pipeline, outputs, restart and reload."""
