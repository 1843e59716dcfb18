"""Messages that are sent over zenoh and written by commands: one ``msgspec.Struct`` for each."""
