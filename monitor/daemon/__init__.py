"""The service: device workers, pipeline, outputs, restart and reload."""
