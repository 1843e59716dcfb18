"""Attack suite: inputs made to exhaust memory or processor time, or to make a command fail without saying why."""
