"""Messages on the wire: encoding and decoding."""
