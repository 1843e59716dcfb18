"""Sentences with the checksum of NMEA 0183, for the tests of decoders of text."""

from drivers.decoders.base import xor_checksum


def make_sentence(body: bytes) -> bytes:
    """Return ``$body*checksum`` with CR LF."""
    return b"$%b*%02X\r\n" % (body, xor_checksum(body))
