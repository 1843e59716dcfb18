"""Decoder of packets from WitMotion WT901, JY61 and BWT61 sensors (UART) and from Bluetooth models.

UART packets have 11 bytes: ``55 | type | 8 bytes | SUM``. SUM is the low byte of the sum of the ten bytes before it.
Type 0x51 contains the accelerations xyz and the temperature, type 0x52 the angular rates xyz. The numbers are i16
little-endian with a full scale of 32768. One sample is a 0x51 packet directly followed by a 0x52 packet. A 0x51 or 0x52
packet without the other packet of the pair is dropped. The packets contain no counter. The temperature is taken from
0x51, since the fourth word of 0x52 is not a temperature on every model (WT901 data sheet v20-0702, section 5.1). The
decoder uses g = 9.80665 m/s², while the manual uses 9.8 m/s².

If a packet of another type (angles, magnetic field) is damaged, no sample is lost. The number of lost samples is
therefore computed from the number of packets between two samples.

Bluetooth packets have 20 bytes without a checksum: ``55 61 | a xyz | w xyz | angles``. A Bluetooth packet is accepted
only if the header of another packet follows. Samples are therefore delayed by one packet.
"""

from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field

from drivers.data_types import ArrivalTimedFormat, Chunk, Floats, Ints, SampleBlock, Timing
from drivers.decoders import base
from drivers.units import DEGREE, G0
from drivers.validation.number_ranges import FULL_SCALE
from drivers.validation.settings_model import SettingsModel

ACCEL, RATE = 0x51, 0x52
TYPES: Final = range(0x50, 0x60)
UART_LENGTH: Final = 11
BLUETOOTH_LENGTH: Final = 20
HEADERS: Final = (b"\x55\x61", b"\x55\x71")
"""Headers of the two types of Bluetooth packets, which contain a sample or the answer to a register read."""
MIN_PACKETS_PER_SAMPLE: Final = 2
CYCLE_SAMPLES: Final = 8
"""Number of recent samples from which the number of packets per sample is estimated, as the minimum over the samples.

The minimum is used because some packet types may be sent only occasionally.
"""
MAX_UNPAIRED_PACKETS: Final = 100
"""Number of consecutive packets without a 0x51/0x52 pair after which a problem is reported."""
TEMPERATURE: Final = {"wt901": (1.0 / 100.0, 0.0), "jy61": (1.0 / 340.0, 36.53)}
"""Step and offset of the temperature by model family: °C = raw · step + offset.

Sources: WT901 data sheet v20-0702, BWT61CL data sheet v20-0630.
"""


class Settings(SettingsModel):
    """Keys of ``[device.driver.decoder_options]``."""

    packet: Literal["uart", "bluetooth"] = Field(
        "uart",
        description="uart: packets of 11 bytes with a checksum; bluetooth: packets of 20 bytes without a checksum",
    )
    temperature: Literal["wt901", "jy61"] = Field(
        "wt901",
        description="temperature formula: raw / 100 (wt901), or raw / 340 + 36.53 (jy61, also for BWT61)",
    )
    accelerometer_range: Annotated[float, FULL_SCALE] = Field(16.0, description="full scale of the accelerometer in g")
    gyro_range: Annotated[float, FULL_SCALE] = Field(2000.0, description="full scale of the gyroscope in °/s")


class WitmotionDecoder(base.FrameStreamDecoder):
    """Decoder and encoder of WitMotion packets."""

    def __init__(self, settings: Settings) -> None:
        self._bluetooth = settings.packet == "bluetooth"
        if self._bluetooth:
            super().__init__(b"\x55", _match_bluetooth, BLUETOOTH_LENGTH + 2)
        else:
            super().__init__(b"\x55", _match_uart, UART_LENGTH)
        self.timing: Timing = ArrivalTimedFormat()
        self._accel_step = settings.accelerometer_range * G0 / 2**15
        self._gyro_step = settings.gyro_range * DEGREE / 2**15
        self._temperature_step, self._temperature_offset = TEMPERATURE[settings.temperature]
        self._harmless_rejects = 0  # number of rejected packets that did not belong to a lost sample
        self._pairs = PacketPairFinder()

    @property
    def bad(self) -> int:
        """Total number of packets with a wrong checksum and of implausible samples."""
        return super().bad + self._harmless_rejects

    @property
    def recent_problem(self) -> str:
        """Reason why samples are missing or packets were rejected; "" if there is no problem."""
        if self._pairs.unpaired > MAX_UNPAIRED_PACKETS:
            return "packets arrive, but no 0x51 directly followed by 0x52: enable both outputs in the sensor"
        return super().recent_problem

    def forget_stream_state(self) -> None:
        """Discard a partially received packet, or a 0x51 packet without its 0x52 packet."""
        super().forget_stream_state()
        self._pairs = PacketPairFinder()

    def _decode(self, frames: base.RawFrames) -> list[SampleBlock]:
        return self._decode_bluetooth(frames) if self._bluetooth else self._decode_uart(frames)

    def _decode_bluetooth(self, frames: base.RawFrames) -> list[SampleBlock]:
        kept = frames.select_frames([i for i, f in enumerate(frames.data) if f[1] == HEADERS[0][1]])
        words = np.frombuffer(b"".join(kept.data), "<i2").reshape(-1, BLUETOOTH_LENGTH // 2)
        values = self._to_si(words[:, 4:7], words[:, 1:4])
        return self._builder.build_plausible_blocks(kept.t_ns, values, None, None, kept.bad_before, kept.bad_after)

    def _decode_uart(self, frames: base.RawFrames) -> list[SampleBlock]:
        at, packets, missing, harmless = self._pairs.find_pairs(frames)
        self._harmless_rejects += harmless
        words = np.ascontiguousarray(packets[:, :, 2:10]).view("<i2")  # [n, 0x51 and 0x52, 4]
        values = self._to_si(words[:, 1, :3], words[:, 0, :3])
        temperature_c = words[:, 0, 3] * self._temperature_step + self._temperature_offset
        return self._builder.build_plausible_blocks(frames.t_ns[at], values, temperature_c, None, missing)

    def _to_si(self, gyro: Ints, accel: Ints) -> Floats:
        return np.hstack([gyro * self._gyro_step, accel * self._accel_step])

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Encode each sample as one chunk. NaN is sent as 0, since the format cannot mark missing values."""
        n = len(samples)
        gyro = base.quantize(samples.values[:, :3], self._gyro_step, 16)
        accel = base.quantize(samples.values[:, 3:], self._accel_step, 16)
        if self._bluetooth:
            words = np.hstack([accel, gyro, np.zeros((n, 3), np.int64)]).astype("<i2")
            return base.make_chunks([HEADERS[0] + row.tobytes() for row in words], samples.t_ns)
        excess = samples.temperature_c - self._temperature_offset
        temperature = base.quantize(excess, self._temperature_step, 16)[:, None]
        frames = [
            encode_packet(ACCEL, first.tobytes()) + encode_packet(RATE, second.tobytes())
            for first, second in zip(
                np.hstack([accel, temperature]).astype("<i2"),
                np.hstack([gyro, np.zeros((n, 1), np.int64)]).astype("<i2"),
                strict=True,
            )
        ]
        return base.make_chunks(frames, samples.t_ns)


class PacketPairFinder:
    """Finder of pairs of 0x51 and 0x52 packets. The finder also counts the samples lost between two pairs."""

    def __init__(self) -> None:
        self.unpaired = 0  # number of packets since the last pair
        self._last = bytes(UART_LENGTH)  # last packet of the previous call
        self._elapsed = 0  # number of packets since the last pair, including rejected packets
        self._rejected = 0  # number of rejected packets and separated pairs since the last pair
        self._recent_cycles: list[int] = []  # packets per sample of the last samples without a rejected packet
        self._first = True

    def find_pairs(self, frames: base.RawFrames) -> tuple[Ints, base.Bytes, Ints, int]:
        """Find pairs of 0x51 and 0x52 packets in the received packets.

        Returns
        -------
        indices : array of int64, shape (n,)
            Index of the 0x52 packet of each pair.
        packets : array of uint8, shape (n, 2, 11)
            Both packets of each pair.
        missing : array of int64, shape (n,)
            Number of samples missing before each pair.
        harmless : int
            Number of rejected packets that did not belong to a missing sample.
        """
        joined = np.frombuffer(self._last + b"".join(frames.data), np.uint8).reshape(-1, UART_LENGTH)
        self._last = frames.data[-1]
        kinds = joined[:, 1]
        in_order = (kinds[:-1] == ACCEL) & (kinds[1:] == RATE)
        at = np.flatnonzero(in_order & frames.adjacent)
        # Bytes between the two packets may be the rest of many lost packets, so the two packets may not belong
        # together.
        separated = in_order & ~frames.adjacent & (frames.bad_before == 0)
        elapsed = self._elapsed + np.cumsum(1 + frames.bad_before)
        rejected = self._rejected + np.cumsum(frames.bad_before + separated)
        steps = np.diff(elapsed[at], prepend=0)
        holes = np.diff(rejected[at], prepend=0)
        missing, harmless = self._count_missing(steps, holes)
        self._elapsed = int(elapsed[-1] - (elapsed[at[-1]] if at.size else 0))
        self._rejected = int(rejected[-1] - (rejected[at[-1]] if at.size else 0))
        self.unpaired = self._elapsed
        return at, np.stack([joined[at], joined[at + 1]], axis=1), missing, harmless

    def _count_missing(self, steps: Ints, holes: Ints) -> tuple[Ints, int]:
        """Return the number of samples missing before each pair [n], and the number of harmless rejected packets.
        ``steps`` [n] and ``holes`` [n] are the numbers of all packets and of rejected packets since the previous pair.
        """
        if not steps.size:
            return steps, 0
        whole = holes == 0
        whole[0] &= not self._first  # reading may have begun within the first sample
        usual = [*self._recent_cycles, *steps[whole].tolist()]
        known = len(self._recent_cycles) + np.cumsum(whole)
        missing = np.zeros(steps.size, np.int64)
        # Only earlier samples are used, so that the division into chunks does not affect the result.
        for row in np.flatnonzero(holes).tolist():
            cycle = min(usual[max(known[row] - CYCLE_SAMPLES, 0) : known[row]], default=MIN_PACKETS_PER_SAMPLE)
            missing[row] = max(round(steps[row] / cycle) - 1, 0)
        self._recent_cycles = usual[-CYCLE_SAMPLES:]
        self._first = False
        return missing, int(np.maximum(holes - missing, 0).sum())


def encode_packet(packet_type: int, data: bytes) -> bytes:
    """Return an 11-byte packet.

    Parameters
    ----------
    packet_type
        Type of the packet, such as 0x51.
    data
        Content of 8 bytes.
    """
    body = bytes([0x55, packet_type]) + data
    return body + bytes([sum(body) & 0xFF])


def _match_uart(buffer: bytes, at: int) -> int:
    if len(buffer) < at + UART_LENGTH:
        return base.NEED_MORE
    if buffer[at + 1] not in TYPES or sum(buffer[at : at + 10]) & 0xFF != buffer[at + 10]:
        return base.REJECT
    return UART_LENGTH


def _match_bluetooth(buffer: bytes, at: int) -> int:
    """Return the length of a Bluetooth packet if the header of another packet follows."""
    if len(buffer) < at + BLUETOOTH_LENGTH + 2:
        return base.NEED_MORE
    following = buffer[at + BLUETOOTH_LENGTH : at + BLUETOOTH_LENGTH + 2]
    return BLUETOOTH_LENGTH if buffer[at : at + 2] in HEADERS and following in HEADERS else base.REJECT


def build(settings: Settings) -> base.Decoder:
    """Return a decoder of WitMotion packets with the given settings."""
    return WitmotionDecoder(settings)
