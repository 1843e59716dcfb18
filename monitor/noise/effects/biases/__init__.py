"""Effects that add a bias or change it with time or temperature."""
