"""Effects that couple one axis to another axis or to the acceleration."""
