"""WitMotion WT901, JY61 and BWT61 over UART, and the Bluetooth models' combined packet.

UART: 11-byte packets ``55 | type | 8 bytes | SUM``, SUM the low byte of the sum of the ten before it. Type
0x51 holds acceleration xyz and temperature, 0x52 rates xyz, as i16 little-endian of full scale 32768. One
sample is a 0x51 with the 0x52 that follows it at once; either without the other is dropped. There is no
counter. The temperature is that of 0x51: the fourth word of 0x52 is not one on every model. (WT901 data
sheet v20-0702, section 5.1.) The manual reckons g = 9.8; here it is 9.80665 m/s².

A damaged packet of another type (angles, magnetic field) costs no sample: how many samples a hole swallowed
is told from the number of packets between two samples.

Bluetooth: 20-byte packets ``55 61 | a xyz | w xyz | angles`` without any checksum. One is believed only when
the header of the next follows it, so that a sample comes one packet late.
"""

from collections.abc import Sequence
from typing import ClassVar, Final, Literal

import numpy as np

from drivers.decoders.base import (
    NEED_MORE,
    REJECT,
    Decoder,
    DecoderSettings,
    FrameBuffer,
    Frames,
    Rows,
    Unmeasured,
    one_chunk_each,
    quantize,
)
from drivers.errors import ConfigError
from drivers.sample import Arrival, Chunk, Floats, Ints, SampleBlock, Timing
from drivers.units import DEGREE, G0

ACCEL, RATE = 0x51, 0x52
TYPES: Final = range(0x50, 0x60)
UART_LENGTH: Final = 11
BLUETOOTH_LENGTH: Final = 20
HEADERS: Final = (b"\x55\x61", b"\x55\x71")
"""Of the Bluetooth models: a sample, and the answer to a register read."""
FEWEST: Final = 2
"""Packets a sample."""
USUAL: Final = 8
"""Samples, of which the shortest tells how many packets there are in one now: others come only now and then."""

# °C = raw * step + offset, by family (WT901 data sheet v20-0702; BWT61CL v20-0630)
TEMPERATURE: Final = {"wt901": (1.0 / 100.0, 0.0), "jy61": (1.0 / 340.0, 36.53)}


class Settings(DecoderSettings, frozen=True):
    """Keys of ``[device.driver.decoder_options]``."""

    packet: Literal["uart", "bluetooth"] = "uart"
    """uart: 11-byte packets with a checksum; bluetooth: 20-byte packets without one."""
    temperature: Literal["wt901", "jy61"] = "wt901"
    """Rule of the family: raw / 100, or raw / 340 + 36.53 (JY61, BWT61)."""
    accelerometer_range: float = 16.0
    """Full scale in g."""
    gyro_range: float = 2000.0
    """Full scale in °/s."""


class WitmotionDecoder:
    """WitMotion packets <-> SampleBlock."""

    carrier: ClassVar[str] = "bytes"

    def __init__(self, settings: Settings) -> None:
        self._bluetooth = settings.packet == "bluetooth"
        self.timing: Timing = Arrival()
        self._accel_step = settings.accelerometer_range * G0 / 2**15
        self._gyro_step = settings.gyro_range * DEGREE / 2**15
        self._temperature_step, self._temperature_offset = TEMPERATURE[settings.temperature]
        if self._bluetooth:
            self._buffer = FrameBuffer(b"\x55", match_bluetooth, BLUETOOTH_LENGTH + 2)
        else:
            self._buffer = FrameBuffer(b"\x55", match_uart, UART_LENGTH)
        self._rows = Rows()
        self._harmless = 0  # rejected packets that cost no sample
        self._pairs = Pairs()

    @property
    def bad(self) -> int:
        """Packets that failed their check, and samples that cannot be."""
        return self._rows.bad + self._harmless

    @property
    def hint(self) -> str:
        """Why there are no samples, or rejected packets."""
        if self._pairs.unpaired > 100:
            return "packets come, but not 0x51 and 0x52 in a row: switch both outputs on in the sensor"
        return self._buffer.hint

    def reset(self) -> None:
        """Forget a half-received packet or pair."""
        self._buffer.reset()
        self._rows.reset()
        self._pairs = Pairs()

    def feed(self, chunks: Sequence[Chunk]) -> list[SampleBlock]:
        """Samples of the packets that these chunks complete."""
        frames = self._buffer.feed(chunks)
        if not frames.data:
            return []
        return self._combined(frames) if self._bluetooth else self._paired(frames)

    def _combined(self, frames: Frames) -> list[SampleBlock]:
        kept, bad_after = frames.keep([i for i, f in enumerate(frames.data) if f[1] == HEADERS[0][1]])
        n = len(kept.data)
        words = np.frombuffer(b"".join(kept.data), "<i2").reshape(n, 10)
        values = self._values(words[:, 4:7], words[:, 1:4])
        nothing = Unmeasured.temperature(n), Unmeasured.ticks(n)
        return self._rows.blocks(kept.t_ns, values, *nothing, kept.bad_before, bad_after)

    def _paired(self, frames: Frames) -> list[SampleBlock]:
        at, packets, missing, harmless = self._pairs.find(frames)
        self._harmless += harmless
        words = np.ascontiguousarray(packets[:, :, 2:10]).view("<i2")  # [n, 0x51 and 0x52, 4]
        values = self._values(words[:, 1, :3], words[:, 0, :3])
        temperature_c = words[:, 0, 3] * self._temperature_step + self._temperature_offset
        ticks = Unmeasured.ticks(at.size)
        return self._rows.blocks(frames.t_ns[at], values, temperature_c, ticks, missing)

    def _values(self, gyro: Ints, accel: Ints) -> Floats:
        return np.hstack([gyro * self._gyro_step, accel * self._accel_step])

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Both packets of a sample in one chunk; what is not measured is sent as 0, as it cannot be said."""
        n = len(samples)
        gyro = quantize(samples.values[:, :3], self._gyro_step, 16)
        accel = quantize(samples.values[:, 3:], self._accel_step, 16)
        if self._bluetooth:
            words = np.hstack([accel, gyro, np.zeros((n, 3), np.int64)]).astype("<i2")
            return one_chunk_each([HEADERS[0] + row.tobytes() for row in words], samples.t_ns)
        excess = samples.temperature_c - self._temperature_offset
        warm = quantize(np.nan_to_num(excess), self._temperature_step, 16)[:, None]
        frames = [
            packet(ACCEL, first.tobytes()) + packet(RATE, second.tobytes())
            for first, second in zip(
                np.hstack([accel, warm]).astype("<i2"),
                np.hstack([gyro, np.zeros((n, 1), np.int64)]).astype("<i2"),
                strict=True,
            )
        ]
        return one_chunk_each(frames, samples.t_ns)


class Pairs:
    """Finds each 0x51 with its 0x52 in a stream of packets, and how many samples each hole swallowed."""

    def __init__(self) -> None:
        self.unpaired = 0  # packets since the last pair
        self._last = bytes(UART_LENGTH)  # the packet before the next one
        self._elapsed = 0  # packets since the last pair's end, rejected ones too
        self._rejected = 0  # those of them that were rejected, and halves torn apart
        self._usual: list[int] = []  # packets of the last samples of which none was rejected
        self._first = True

    def find(self, frames: Frames) -> tuple[Ints, np.ndarray[tuple[int, ...], np.dtype[np.uint8]], Ints, int]:
        """(index of each pair's 0x52, packets [n, 2, 11], samples missing before each, harmless rejects)."""
        joined = np.frombuffer(self._last + b"".join(frames.data), np.uint8).reshape(-1, UART_LENGTH)
        self._last = frames.data[-1]
        kinds = joined[:, 1]
        fits = (kinds[:-1] == ACCEL) & (kinds[1:] == RATE)
        at = np.flatnonzero(fits & frames.at_once)
        # bytes too few for a packet may be the rest of many: the halves need not be of one sample
        torn = fits & ~frames.at_once & (frames.bad_before == 0)
        elapsed = self._elapsed + np.cumsum(1 + frames.bad_before)
        rejected = self._rejected + np.cumsum(frames.bad_before + torn)
        steps = np.diff(elapsed[at], prepend=0)
        holes = np.diff(rejected[at], prepend=0)
        missing, harmless = self._count(steps, holes)
        self._elapsed = int(elapsed[-1] - (elapsed[at[-1]] if at.size else 0))
        self._rejected = int(rejected[-1] - (rejected[at[-1]] if at.size else 0))
        self.unpaired = self._elapsed
        return at, np.stack([joined[at], joined[at + 1]], axis=1), missing, harmless

    def _count(self, steps: Ints, holes: Ints) -> tuple[Ints, int]:
        if not steps.size:
            return steps, 0
        whole = holes == 0
        whole[0] &= not self._first  # it tells when we joined, not how many packets make a sample
        usual = [*self._usual, *steps[whole].tolist()]
        known = len(self._usual) + np.cumsum(whole)
        missing = np.zeros(steps.size, np.int64)
        for row in np.flatnonzero(holes).tolist():  # by what came before it, however the bytes are cut
            cycle = min(usual[max(known[row] - USUAL, 0) : known[row]], default=FEWEST)
            missing[row] = max(round(steps[row] / cycle) - 1, 0)
        self._usual = usual[-USUAL:]
        self._first = False
        return missing, int(np.maximum(holes - missing, 0).sum())


def packet(kind: int, data: bytes) -> bytes:
    """An 11-byte packet."""
    body = bytes([0x55, kind]) + data
    return body + bytes([sum(body) & 0xFF])


def match_uart(buffer: bytes, at: int) -> int:
    """Length of the packet at this place, if it is whole and its sum holds."""
    if len(buffer) < at + UART_LENGTH:
        return NEED_MORE
    if buffer[at + 1] not in TYPES or sum(buffer[at : at + 10]) & 0xFF != buffer[at + 10]:
        return REJECT
    return UART_LENGTH


def match_bluetooth(buffer: bytes, at: int) -> int:
    """Length of the packet at this place, if it has a header and another header follows."""
    if len(buffer) < at + BLUETOOTH_LENGTH + 2:
        return NEED_MORE
    following = buffer[at + BLUETOOTH_LENGTH : at + BLUETOOTH_LENGTH + 2]
    return BLUETOOTH_LENGTH if buffer[at : at + 2] in HEADERS and following in HEADERS else REJECT


def build(settings: Settings) -> Decoder:
    """A decoder with these settings; ConfigError for a range that is none."""
    ranges = (("accelerometer_range", settings.accelerometer_range, "g"), ("gyro_range", settings.gyro_range, "°/s"))
    if wrong := [f"{key}: {value:g} {unit}; it is above 0" for key, value, unit in ranges if not value > 0.0]:
        raise ConfigError(*wrong)
    return WitmotionDecoder(settings)
