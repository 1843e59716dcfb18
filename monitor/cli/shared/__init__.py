"""Options, output and error messages that the commands share."""
