"""Publisher, subscriber and history queries over zenoh."""
