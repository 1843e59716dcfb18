"""Support code that several test modules share: waiting, ports, kernels, zenoh sessions, processes, recordings."""
