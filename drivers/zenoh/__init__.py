"""Connection to zenoh: sessions, causes of connection errors, and the message format of samples."""
