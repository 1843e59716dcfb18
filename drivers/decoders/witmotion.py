"""WitMotion WT901, JY61 and BWT61 over UART, and the combined packet of the Bluetooth models.

UART packets have 11 bytes: ``55 | type | 8 bytes | SUM``. SUM is the low byte of the sum of the ten bytes before it.
Type 0x51 contains acceleration xyz and temperature, type 0x52 rates xyz, as i16 little-endian with a full scale of
32768. One sample is a 0x51 packet directly followed by a 0x52 packet. A packet without its partner is dropped. There is
no counter. The temperature is taken from 0x51, since the fourth word of 0x52 is not a temperature on every model (WT901
data sheet v20-0702, section 5.1). The manual uses g = 9.8 m/s²; here it is 9.80665 m/s².

A damaged packet of another type (angles, magnetic field) costs no sample. The number of samples lost in a gap is
therefore derived from the number of packets between two samples.

Bluetooth packets have 20 bytes without a checksum: ``55 61 | a xyz | w xyz | angles``. A packet is accepted only when
the header of the next packet follows it. Samples are therefore delayed by one packet.
"""

from collections.abc import Sequence
from typing import Annotated, ClassVar, Final, Literal

import numpy as np
from pydantic import Field

from drivers.decoders.base import (
    NEED_MORE,
    REJECT,
    BlockBuilder,
    Decoder,
    DecoderSettings,
    FrameBuffer,
    Frames,
    Unmeasured,
    chunk_per_sample,
    quantize,
)
from drivers.quantities import FULL_SCALE
from drivers.sample import ArrivalTiming, Chunk, Floats, Ints, SampleBlock, Timing
from drivers.units import DEGREE, G0

ACCEL, RATE = 0x51, 0x52
TYPES: Final = range(0x50, 0x60)
UART_LENGTH: Final = 11
BLUETOOTH_LENGTH: Final = 20
HEADERS: Final = (b"\x55\x61", b"\x55\x71")
"""Headers of the Bluetooth models: a sample, and the answer to a register read."""
MIN_PACKETS_PER_SAMPLE: Final = 2
"""Minimum number of packets per sample."""
CYCLE_SAMPLES: Final = 8
"""Number of recent samples that determine the packets per sample.

The sample with the fewest packets counts, since packets of other types are sent only occasionally.
"""

# °C = raw * step + offset, by family (WT901 data sheet v20-0702; BWT61CL v20-0630)
TEMPERATURE: Final = {"wt901": (1.0 / 100.0, 0.0), "jy61": (1.0 / 340.0, 36.53)}


class Settings(DecoderSettings):
    """Keys of ``[device.driver.decoder_options]``."""

    packet: Literal["uart", "bluetooth"] = Field(
        "uart", description="packets of 11 bytes with a checksum, or of 20 bytes without one"
    )
    temperature: Literal["wt901", "jy61"] = Field(
        "wt901", description="temperature formula of the model family: raw / 100, or raw / 340 + 36.53 (JY61, BWT61)"
    )
    accelerometer_range: Annotated[float, FULL_SCALE] = Field(16.0, description="full scale of the accelerometer in g")
    gyro_range: Annotated[float, FULL_SCALE] = Field(2000.0, description="full scale of the gyroscope in °/s")


class WitmotionDecoder:
    """Decoder and encoder of WitMotion packets."""

    carrier: ClassVar[str] = "bytes"

    def __init__(self, settings: Settings) -> None:
        self._bluetooth = settings.packet == "bluetooth"
        self.timing: Timing = ArrivalTiming()
        self._accel_step = settings.accelerometer_range * G0 / 2**15
        self._gyro_step = settings.gyro_range * DEGREE / 2**15
        self._temperature_step, self._temperature_offset = TEMPERATURE[settings.temperature]
        if self._bluetooth:
            self._buffer = FrameBuffer(b"\x55", match_bluetooth, BLUETOOTH_LENGTH + 2)
        else:
            self._buffer = FrameBuffer(b"\x55", match_uart, UART_LENGTH)
        self._rows = BlockBuilder()
        self._harmless_rejects = 0  # number of rejected packets that cost no sample
        self._pairs = Pairs()

    @property
    def bad(self) -> int:
        """Number of packets that failed their check, and of implausible samples."""
        return self._rows.bad + self._harmless_rejects

    @property
    def hint(self) -> str:
        """Reason for missing samples or rejected packets."""
        if self._pairs.unpaired > 100:
            return "packets come, but not 0x51 and 0x52 in a row: switch both outputs on in the sensor"
        return self._buffer.hint

    def reset(self) -> None:
        """Forget an incomplete packet or pair."""
        self._buffer.reset()
        self._rows.reset()
        self._pairs = Pairs()

    def feed(self, chunks: Sequence[Chunk]) -> list[SampleBlock]:
        """Return the samples of the packets that these chunks complete."""
        frames = self._buffer.feed(chunks)
        if not frames.data:
            return []
        return self._combined(frames) if self._bluetooth else self._paired(frames)

    def _combined(self, frames: Frames) -> list[SampleBlock]:
        """Return the samples of Bluetooth packets."""
        kept, bad_after = frames.keep([i for i, f in enumerate(frames.data) if f[1] == HEADERS[0][1]])
        n = len(kept.data)
        words = np.frombuffer(b"".join(kept.data), "<i2").reshape(n, 10)
        values = self._values(words[:, 4:7], words[:, 1:4])
        nothing = Unmeasured.temperature(n), Unmeasured.ticks(n)
        return self._rows.blocks(kept.t_ns, values, *nothing, kept.bad_before, bad_after)

    def _paired(self, frames: Frames) -> list[SampleBlock]:
        """Return the samples of UART packets."""
        at, packets, missing, harmless = self._pairs.find(frames)
        self._harmless_rejects += harmless
        words = np.ascontiguousarray(packets[:, :, 2:10]).view("<i2")  # [n, 0x51 and 0x52, 4]
        values = self._values(words[:, 1, :3], words[:, 0, :3])
        temperature_c = words[:, 0, 3] * self._temperature_step + self._temperature_offset
        ticks = Unmeasured.ticks(at.size)
        return self._rows.blocks(frames.t_ns[at], values, temperature_c, ticks, missing)

    def _values(self, gyro: Ints, accel: Ints) -> Floats:
        """Convert raw words to rad/s and m/s² [n, 6]."""
        return np.hstack([gyro * self._gyro_step, accel * self._accel_step])

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Return both packets of each sample in one chunk.

        The format cannot mark unmeasured values, so they are sent as 0.
        """
        n = len(samples)
        gyro = quantize(samples.values[:, :3], self._gyro_step, 16)
        accel = quantize(samples.values[:, 3:], self._accel_step, 16)
        if self._bluetooth:
            words = np.hstack([accel, gyro, np.zeros((n, 3), np.int64)]).astype("<i2")
            return chunk_per_sample([HEADERS[0] + row.tobytes() for row in words], samples.t_ns)
        excess = samples.temperature_c - self._temperature_offset
        warm = quantize(np.nan_to_num(excess), self._temperature_step, 16)[:, None]
        frames = [
            encode_packet(ACCEL, first.tobytes()) + encode_packet(RATE, second.tobytes())
            for first, second in zip(
                np.hstack([accel, warm]).astype("<i2"),
                np.hstack([gyro, np.zeros((n, 1), np.int64)]).astype("<i2"),
                strict=True,
            )
        ]
        return chunk_per_sample(frames, samples.t_ns)


class Pairs:
    """Finder of pairs of 0x51 and 0x52 packets, which also counts the samples lost in each gap."""

    def __init__(self) -> None:
        self.unpaired = 0  # number of packets since the last pair
        self._last = bytes(UART_LENGTH)  # last packet of the previous call
        self._elapsed = 0  # packets since the end of the last pair, including rejected ones
        self._rejected = 0  # number of these packets that were rejected, and of separated pairs
        self._recent_cycles: list[int] = []  # packets per sample of the last samples without a rejected packet
        self._first = True

    def find(self, frames: Frames) -> tuple[Ints, np.ndarray[tuple[int, ...], np.dtype[np.uint8]], Ints, int]:
        """Find the pairs in a list of packets.

        Parameters
        ----------
        frames
            Packets in order of arrival.

        Returns
        -------
        tuple
            Index of the 0x52 packet of each pair [n], packets [n, 2, 11] as uint8, samples missing before each pair
            [n], and number of rejected packets that cost no sample.
        """
        joined = np.frombuffer(self._last + b"".join(frames.data), np.uint8).reshape(-1, UART_LENGTH)
        self._last = frames.data[-1]
        kinds = joined[:, 1]
        fits = (kinds[:-1] == ACCEL) & (kinds[1:] == RATE)
        at = np.flatnonzero(fits & frames.at_once)
        # a few stray bytes may remain of many packets, so both packets need not belong to one sample
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
        """Return the samples missing before each pair [n], and the number of rejected packets that cost no sample."""
        if not steps.size:
            return steps, 0
        whole = holes == 0
        whole[0] &= not self._first  # it depends on when reading began, not on the packets per sample
        usual = [*self._recent_cycles, *steps[whole].tolist()]
        known = len(self._recent_cycles) + np.cumsum(whole)
        missing = np.zeros(steps.size, np.int64)
        for row in np.flatnonzero(holes).tolist():  # earlier samples only: independent of the chunks
            cycle = min(usual[max(known[row] - CYCLE_SAMPLES, 0) : known[row]], default=MIN_PACKETS_PER_SAMPLE)
            missing[row] = max(round(steps[row] / cycle) - 1, 0)
        self._recent_cycles = usual[-CYCLE_SAMPLES:]
        self._first = False
        return missing, int(np.maximum(holes - missing, 0).sum())


def encode_packet(kind: int, data: bytes) -> bytes:
    """Return an 11-byte packet.

    Parameters
    ----------
    kind
        Type of the packet, such as 0x51.
    data
        Content of 8 bytes.
    """
    body = bytes([0x55, kind]) + data
    return body + bytes([sum(body) & 0xFF])


def match_uart(buffer: bytes, at: int) -> int:
    """Return the length of a UART packet.

    Parameters
    ----------
    buffer
        Received bytes.
    at
        Offset of a candidate.

    Returns
    -------
    int
        Length in bytes, NEED_MORE, or REJECT.
    """
    if len(buffer) < at + UART_LENGTH:
        return NEED_MORE
    if buffer[at + 1] not in TYPES or sum(buffer[at : at + 10]) & 0xFF != buffer[at + 10]:
        return REJECT
    return UART_LENGTH


def match_bluetooth(buffer: bytes, at: int) -> int:
    """Return the length of a Bluetooth packet if another header follows it.

    Parameters
    ----------
    buffer
        Received bytes.
    at
        Offset of a candidate.

    Returns
    -------
    int
        Length in bytes, NEED_MORE, or REJECT.
    """
    if len(buffer) < at + BLUETOOTH_LENGTH + 2:
        return NEED_MORE
    following = buffer[at + BLUETOOTH_LENGTH : at + BLUETOOTH_LENGTH + 2]
    return BLUETOOTH_LENGTH if buffer[at : at + 2] in HEADERS and following in HEADERS else REJECT


def build(settings: Settings) -> Decoder:
    """Return a decoder with these settings."""
    return WitmotionDecoder(settings)
