"""Extraction of a CAN signal from an array of frames, and insertion of a signal into frames.

Frames are a uint8 array [n, size], and values are a float64 array [n]. Bits are numbered from the least significant bit
of each byte for Intel signals, and from the most significant bit of each byte for Motorola signals.
"""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Floats
from drivers.decoders.base import Bytes

FIRST_INDICATOR: Final = 0xFE
"""Smallest top byte of a raw value that means "error" or "not available" (SAE J1939-71)."""
ALL_ONES: Final = np.uint64((1 << 64) - 1)

RawNumbers = NDArray[np.uint64]


@dataclass(frozen=True, slots=True)
class SignalCodec:
    """Position of a signal in a CAN frame, and the conversion from the raw number to a physical value."""

    first: int  # number of the first bit
    length: int
    big_endian: bool
    signed: bool
    is_float: bool
    scale: float
    offset: float
    indicators: bool  # True if raw values in the top 2/256 of the range mean "error" or "not available"

    @property
    def end_byte(self) -> int:
        """Number of bytes from the start of the frame to the end of the signal."""
        return (self.first + self.length - 1) // 8 + 1

    @property
    def _bit_order(self) -> Literal["big", "little"]:
        return "big" if self.big_endian else "little"

    def extract_raw(self, frames: Bytes) -> RawNumbers:
        """Return the raw numbers [n] of frames [n, size]."""
        bits = np.unpackbits(frames, axis=1, bitorder=self._bit_order)[:, self.first : self.first + self.length]
        padded = np.zeros((len(frames), 64), np.uint8)
        padded[:, : self.length] = bits[:, ::-1] if self.big_endian else bits
        return np.packbits(padded, axis=1, bitorder="little").view("<u8")[:, 0].astype(np.uint64)

    def extract_values(self, frames: Bytes) -> Floats:
        """Return the values [n] of frames [n, size] in the unit of the DBC file; NaN for "error" or "not available"."""
        raw = self.extract_raw(frames)
        values = self._to_float(raw) * self.scale + self.offset
        if self.indicators:
            # Compare the top byte. Signals shorter than one byte have no raw values for "error" or "not available".
            values = np.where(raw >> np.uint64(self.length - 8) >= FIRST_INDICATOR, np.nan, values)
        return values

    def insert_values(self, frames: Bytes, values: Floats) -> None:
        """Write values into frames, rounded to the resolution and clipped to the range of the signal.

        Parameters
        ----------
        frames
            [n, size] uint8, changed in place.
        values
            [n] float64 in the unit of the DBC file. If ``indicators`` is True, NaN is written as "not available".
        """
        with np.errstate(over="ignore"):
            raw = self._from_float((values - self.offset) / self.scale)
        if self.indicators:
            raw = np.where(np.isnan(values), ALL_ONES, raw)
        self.insert_raw(frames, raw)

    def insert_raw(self, frames: Bytes, raw: RawNumbers) -> None:
        """Write the low bits of raw numbers into frames.

        Parameters
        ----------
        frames
            [n, size] uint8, changed in place.
        raw
            [n] uint64.
        """
        number = np.unpackbits(raw.astype("<u8")[:, None].view(np.uint8), axis=1, bitorder="little")[:, : self.length]
        bits = np.unpackbits(frames, axis=1, bitorder=self._bit_order)
        bits[:, self.first : self.first + self.length] = number[:, ::-1] if self.big_endian else number
        frames[:] = np.packbits(bits, axis=1, bitorder=self._bit_order)

    def _to_float(self, raw: RawNumbers) -> Floats:
        if self.is_float:
            bits = raw.astype(f"<u{self.length // 8}")
            with np.errstate(invalid="ignore"):  # converting a signalling NaN causes a warning
                return bits.view(f"<f{self.length // 8}").astype(np.float64)
        if self.signed:
            unused = np.uint64(64 - self.length)
            signed = (raw << unused).view(np.int64) >> np.int64(64 - self.length)
            return signed.astype(np.float64)
        return raw.astype(np.float64)

    def _from_float(self, numbers: Floats) -> RawNumbers:
        """Convert numbers to raw numbers, rounded and clipped. The bits above ``length`` are undefined."""
        if self.is_float:
            bits: RawNumbers = numbers.astype(f"<f{self.length // 8}").view(f"<u{self.length // 8}").astype(np.uint64)
            return bits
        low = -(1 << self.length - 1) if self.signed else 0
        high = low + (1 << self.length) - 1
        if self.indicators:
            high = (FIRST_INDICATOR << self.length - 8) - 1
        # Use the largest float64 within the range, because float64 cannot represent 2⁶³ - 1.
        top = float(high) if int(float(high)) <= high else np.nextafter(float(high), 0.0)
        whole = np.rint(np.clip(np.nan_to_num(numbers), low, top))
        return whole.astype(np.int64).view(np.uint64) if self.signed else whole.astype(np.uint64)
