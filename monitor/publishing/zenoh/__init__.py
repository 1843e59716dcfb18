"""Publisher, subscriber and queries over zenoh."""
