"""Options, output functions and error messages that the commands share."""
