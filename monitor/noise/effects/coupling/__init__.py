"""Effects that couple one axis to another axis."""
