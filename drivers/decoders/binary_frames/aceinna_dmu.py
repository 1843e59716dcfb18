"""Memsic / Aceinna DMU380, IMU380 and IMU381 (packets S0, S1) and OpenIMU (packets z1, s1) over UART.

The format is ``55 55 | type, two ASCII characters | length u8 | payload | CRC u16be``. The CRC-16 has the polynomial
0x1021 and the initial value 0x1D0F, and covers type, length and payload. Published example commands of both families
confirm the CRC.

==== ================================================================================================================
type payload
==== ================================================================================================================
S0   i16be: acceleration, rate, magnetic field, temperature of the rate sensors, board temperature; u16 time, u16 BIT
S1   i16be: acceleration, rate, temperature of the rate sensors, board temperature; u16 packet counter, u16 BIT
z1   little-endian: u32 time in ms; float32: acceleration, rate in °/s, magnetic field
s1   little-endian: u32 time in ms, float64 time in s; float32: acceleration, rate in °/s, magnetic field, temperature
==== ================================================================================================================

The resolution of S0 and S1 is 20/65536 g, 1260/65536 °/s and 200/65536 °C. The time of S0 consists of the two low bytes
of a time in ms. The temperature is the mean of the temperatures of the three rate sensors. A sample is bad if BIT
reports a fatal error (bit 0) or a sensor over its range (bit 12). Sources: DMU380SA manual 7430-0026 (packets, tables 9
and 15), the scripts Aceinna/python-imu380 and Aceinna/python-openimu, and the OpenIMU documentation.

The sources disagree about the acceleration in z1: the OpenIMU documentation states g, and the description of the
released IMU application states m/s². The key ``accel_unit`` selects the unit. The counter and the time in each packet
serve as the device clock. The type is therefore an option, and packets of other types are ignored.
"""

import binascii
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.data_types import ArrivalTimedFormat, Chunk, CounterTimedFormat, Floats, Ints, SampleBlock, Timing
from drivers.decoders import base
from drivers.units import DEGREE, G0
from drivers.validation.settings_model import SettingsModel

SYNC: Final = b"\x55\x55"
CRC_START: Final = 0x1D0F
LONGEST: Final = 5 + 255 + 2
BIT_ERRORS: Final = 1 << 0 | 1 << 12
"""Bits of the BIT word that make a sample bad: fatal error, and sensor over its range."""
TEMPERATURE_STEP: Final = 200.0 / 2**16


@dataclass(frozen=True)
class PacketType:
    """Payload layout of a packet type, and the resolution of its integers, which is 1 for floating-point numbers."""

    payload: np.dtype[np.void]
    modulus: int
    tick_s: float | None  # None: the clock counts packets
    accel_step: float = 1.0  # g
    gyro_step: float = 1.0  # °/s


def _integer_packet(names: tuple[str, ...], tick_s: float | None) -> PacketType:
    fields = [(name, ">i2", 3) for name in names]
    payload = np.dtype([*fields, ("board", ">i2"), ("clock", ">u2"), ("bit", ">u2")])
    return PacketType(payload, 1 << 16, tick_s, 20.0 / 2**16, 1260.0 / 2**16)


def _float_packet(before: tuple[tuple[str, str], ...], after: tuple[tuple[str, str], ...]) -> PacketType:
    triples = [(name, "<f4", 3) for name in ("accel", "gyro", "magnetic")]
    return PacketType(np.dtype([("clock", "<u4"), *before, *triples, *after]), 1 << 32, 1e-3)


PACKET_TYPES: Final = {
    b"S0": _integer_packet(("accel", "gyro", "magnetic", "temperature"), 1e-3),
    b"S1": _integer_packet(("accel", "gyro", "temperature"), None),
    b"z1": _float_packet((), ()),
    b"s1": _float_packet((("seconds", "<f8"),), (("temperature", "<f4"),)),
}


class Settings(SettingsModel):
    """Keys of ``[device.driver.decoder_options]``."""

    packet: Literal["S0", "S1", "z1", "s1"] = Field(
        "S1", description="type of the packets: S0 or S1 of a DMU380 or IMU380, z1 or s1 of an OpenIMU"
    )
    accel_unit: Literal["m/s^2", "g"] = Field("m/s^2", description="unit of the acceleration in z1 and s1")
    clock: Literal["device", "arrival"] = Field(
        "device", description="source of the sample times; device: packet counter in S1, or time in the other packets"
    )


class AceinnaDmuDecoder(base.FrameStreamDecoder):
    """Decoder and encoder of packets with acceleration and angular rate."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(SYNC, _match_packet, LONGEST)
        self._code = settings.packet.encode()
        self._packet = PACKET_TYPES[self._code]
        self._is_integer = self._code.isupper()
        accel_unit = G0 if self._is_integer or settings.accel_unit == "g" else 1.0
        self._steps = np.repeat([self._packet.gyro_step * DEGREE, self._packet.accel_step * accel_unit], 3)
        self.timing: Timing = ArrivalTimedFormat()
        if settings.clock == "device":
            self.timing = CounterTimedFormat(self._packet.modulus, self._packet.tick_s)
        self._other_code = b""
        self._failed = False

    @property
    def recent_problem(self) -> str:
        """Error that the sensor reports, or reason why there are no samples; "" if there is no problem."""
        if self._failed:
            return "the sensor reports a fatal error or a value over its range in BIT"
        if self._other_code:
            name = self._other_code.decode()
            return f'packets of type {name} arrive, not {self._code.decode()}: set packet = "{name}"'
        return super().recent_problem

    def _decode(self, frames: base.RawFrames) -> list[SampleBlock]:
        codes = [frame[2:4] for frame in frames.data]
        kept = frames.select_frames([i for i, code in enumerate(codes) if code == self._code])
        others = [code for code in codes if code in PACKET_TYPES]
        self._other_code = others[-1] if others and not kept.data else b""
        payload = self._packet.payload
        packets = np.frombuffer(b"".join(frame[5:-2] for frame in kept.data), payload)
        values, temperature_c = self._read_values(packets)
        ticks: Ints | None = None
        if isinstance(self.timing, CounterTimedFormat):
            ticks = packets["clock"].astype(np.int64)
        return self._builder.build_plausible_blocks(
            kept.t_ns, values, temperature_c, ticks, kept.bad_before, kept.bad_after
        )

    def _read_values(self, packets: NDArray[np.void]) -> tuple[Floats, Floats | None]:
        """Return the values [n, 6] and the temperatures [n] in °C. Values of packets with an error are infinite."""
        with np.errstate(invalid="ignore"):  # converting a signalling NaN causes a warning
            measured = np.hstack([packets["gyro"], packets["accel"]]).astype(np.float64)
            values = base.nan_to_infinity(measured * self._steps)
            if not self._is_integer:
                has_temperature = "temperature" in (packets.dtype.names or ())
                return values, packets["temperature"].astype(np.float64) if has_temperature else None
        failed = packets["bit"] & BIT_ERRORS != 0
        if failed.size:
            self._failed = bool(failed[-1])
        values[failed] = np.inf
        return values, packets["temperature"].mean(axis=1) * TEMPERATURE_STEP

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Encode each sample as one packet. S0 and S1 cannot mark missing values and contain 0 instead."""
        rows = np.zeros(len(samples), self._packet.payload)
        numbers = samples.values / self._steps
        rows["clock"] = samples.ticks % self._packet.modulus
        if self._is_integer:
            numbers = base.quantize(numbers, 1.0, 16)
            rows["board"] = base.quantize(samples.temperature_c, TEMPERATURE_STEP, 16)
            rows["temperature"] = rows["board"][:, None]
        elif self._code == b"s1":
            rows["temperature"] = samples.temperature_c
        rows["gyro"], rows["accel"] = numbers[:, :3], numbers[:, 3:]
        return base.make_chunks([encode_packet(self._code, row.tobytes()) for row in rows], samples.t_ns)


def encode_packet(code: bytes, payload: bytes) -> bytes:
    """Return a packet.

    Parameters
    ----------
    code
        Type of the packet, two ASCII characters.
    payload
        Content of at most 255 bytes.
    """
    body = code + bytes([len(payload)]) + payload
    return SYNC + body + binascii.crc_hqx(body, CRC_START).to_bytes(2, "big")


def _match_packet(buffer: bytes, at: int) -> int:
    if len(buffer) < at + 5:
        return base.NEED_MORE
    packet = PACKET_TYPES.get(buffer[at + 2 : at + 4])
    length = buffer[at + 4]
    if packet is not None and length != packet.payload.itemsize:
        return base.REJECT
    end = at + 5 + length + 2
    if len(buffer) < end:
        return base.NEED_MORE
    # The CRC of type, length, payload and CRC field is 0.
    return base.REJECT if binascii.crc_hqx(buffer[at + 2 : end], CRC_START) else end - at


def build(settings: Settings) -> base.Decoder:
    """Return a decoder of packets with the given settings."""
    return AceinnaDmuDecoder(settings)
