"""Bit field of one CAN signal: extraction from, and insertion into, many frames at once.

Frames are bytes [n, size], physical values are [n]. Intel and Motorola byte order are handled alike: the bytes that a
signal touches (its span, at most nine) are put in order of significance and shifted.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.sample import Floats

FIRST_INDICATOR: Final = 0xFE
"""Smallest top byte of a value that is an indicator and not a measurement (SAE J1939-71)."""

Bytes = NDArray[np.uint8]
Raw = NDArray[np.uint64]


@dataclass(frozen=True, slots=True)
class Bits:
    """Position of a signal in its frame, and the conversion of its raw number to a physical value."""

    first: int  # first byte of its span
    span: int  # bytes
    shift: int  # position of the least significant bit, from the least significant end of the span
    length: int
    big_endian: bool
    signed: bool
    is_float: bool
    scale: float
    offset: float
    indicators: bool  # True if values in the top 2/256 of the range are not measured

    def raw(self, frames: Bytes) -> Raw:
        """Return raw numbers [n] of frames [n, size]."""
        span = frames[:, self.first : self.first + self.span]
        if self.big_endian:
            span = span[:, ::-1]
        low = np.zeros((len(frames), 8), np.uint8)
        low[:, : min(self.span, 8)] = span[:, :8]
        words = low.view("<u8")[:, 0].astype(np.uint64) >> np.uint64(self.shift)
        if self.span > 8:  # shift of 1 to 7: the remaining bits are in the ninth byte
            words |= span[:, 8].astype(np.uint64) << np.uint64(64 - self.shift)
        result: Raw = words & self.mask
        return result

    def physical(self, frames: Bytes) -> Floats:
        """Return values [n] in the unit of the DBC; NaN for indicators."""
        raw = self.raw(frames)
        values = self._number(raw) * self.scale + self.offset
        if self.indicators:
            # right shift to the top byte; shorter fields have no indicators
            values = np.where(raw >> np.uint64(self.length - 8) >= FIRST_INDICATOR, np.nan, values)
        return values

    def put(self, frames: Bytes, values: Floats) -> None:
        """Write values into frames, rounded to the nearest step and clipped to the range.

        Parameters
        ----------
        frames
            [n, size] uint8, changed in place.
        values
            [n] float64 in the unit of the DBC. NaN becomes the indicator for not available if the signal has one.
        """
        with np.errstate(over="ignore"):
            raw = self._raw_of((values - self.offset) / self.scale)
        if self.indicators:
            raw = np.where(np.isnan(values), self.mask, raw)
        self.put_raw(frames, raw)

    def put_raw(self, frames: Bytes, raw: Raw) -> None:
        """Write raw numbers into frames.

        Parameters
        ----------
        frames
            [n, size] uint8, changed in place.
        raw
            [n] uint64.
        """
        span = np.zeros((len(frames), max(self.span, 8)), np.uint8)
        used = np.zeros_like(span)
        mask = np.full(len(frames), self.mask)
        for target, number in ((span, raw), (used, mask)):
            target[:, :8] = (number << np.uint64(self.shift)).astype("<u8")[:, None].view(np.uint8)
            if self.span > 8:
                target[:, 8] = number >> np.uint64(64 - self.shift)
        order = slice(None, None, -1) if self.big_endian else slice(None)
        span, used = span[:, : self.span][:, order], used[:, : self.span][:, order]
        place = frames[:, self.first : self.first + self.span]
        place[:] = (place & ~used) | span

    @property
    def mask(self) -> np.uint64:
        """Mask with ones at the bits of the raw number."""
        return np.uint64((1 << self.length) - 1)

    def _number(self, raw: Raw) -> Floats:
        """Return raw numbers as float64 according to their type."""
        if self.is_float:
            bits = raw.astype(f"<u{self.length // 8}")
            with np.errstate(invalid="ignore"):  # a signalling NaN is treated as NaN
                return bits.view(f"<f{self.length // 8}").astype(np.float64)
        if self.signed:
            unused = np.uint64(64 - self.length)
            signed = (raw << unused).view(np.int64) >> np.int64(64 - self.length)
            return signed.astype(np.float64)
        return raw.astype(np.float64)

    def _raw_of(self, numbers: Floats) -> Raw:
        """Return numbers as raw numbers, rounded and clipped to the range."""
        if self.is_float:
            bits: Raw = numbers.astype(f"<f{self.length // 8}").view(f"<u{self.length // 8}").astype(np.uint64)
            return bits
        low = -(1 << self.length - 1) if self.signed else 0
        high = low + (1 << self.length) - 1
        if self.indicators:
            high = (FIRST_INDICATOR << self.length - 8) - 1
        # the largest float64 within the range, since 2⁶³ - 1 is not a float64
        top = float(high) if int(float(high)) <= high else np.nextafter(float(high), 0.0)
        whole = np.rint(np.clip(np.nan_to_num(numbers), low, top))
        result: Raw = whole.astype(np.int64).view(np.uint64) if self.signed else whole.astype(np.uint64)
        return result & self.mask
