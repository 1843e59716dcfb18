"""What the bias does, and taking it out: bias against temperature."""
