"""Wire to numbers: links move bytes, decoders turn them into samples, a clock gives each its time."""
