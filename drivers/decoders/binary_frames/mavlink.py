"""MAVLink 1 and 2 messages with IMU data: HIGHRES_IMU, SCALED_IMU, SCALED_IMU2, SCALED_IMU3 and RAW_IMU.

A frame of MAVLink 2 is ``FD | length | incompatibility flags | compatibility flags | sequence | system | component |
message u24le | payload | CRC u16le``, followed by a signature of 13 bytes if bit 0 of the incompatibility flags is set.
A frame of MAVLink 1 is ``FE | length | sequence | system | component | message u8 | payload | CRC u16le``. MAVLink 2
omits zeros at the end of a payload. The CRC is the CRC-16/MCRF4XX of all bytes after the first byte and of the byte
CRC_EXTRA, which depends on the message. Signatures are not verified. Source: MAVLink developer guide, "Serialization",
and the messages of the dialect common.xml.

The CRC_EXTRA of messages without IMU data is unknown to the decoder. Their CRC is therefore accepted if it is correct
for any value of CRC_EXTRA, which leaves 8 checked bits. MAVLink versions are not mixed: the first valid frame selects
the version until MAX_BYTES_WITHOUT_FRAME bytes arrive without a valid frame of this version.

The sequence number counts all messages of a sender, so it does not show how many samples are missing. Missing samples
are counted from the times in the messages. With ``clock = "arrival"``, they are counted from the arrival times. A
rejected frame counts as bad, even if it might have been a message without IMU data. The sequence numbers before and
after damaged bytes limit the number of rejected frames.

The resolution of SCALED_IMU, SCALED_IMU2 and SCALED_IMU3 is 1 mrad/s and 1 mg, which is coarser than the noise of most
sensors. RAW_IMU contains counts in a unit that depends on the sender. ArduPilot uses mrad/s and mg.
"""

import binascii
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers import units
from drivers.data_types import NO_TICK, ArrivalTimedFormat, Chunk, CounterTimedFormat, Floats, Ints, SampleBlock, Timing
from drivers.decoders import base
from drivers.validation.number_ranges import MAVLINK_ID
from drivers.validation.settings_model import Conflict, SettingsModel, checked_by

VERSION_1, VERSION_2 = 0xFE, 0xFD
HEADER_BYTES: Final = {VERSION_1: 6, VERSION_2: 10}
CRC_BYTES, SIGNATURE_BYTES = 2, 13
LONGEST: Final = HEADER_BYTES[VERSION_2] + 255 + CRC_BYTES + SIGNATURE_BYTES
SIGNED: Final = 0x01
"""Incompatibility flag of a frame with a signature. Frames with any other incompatibility flag are rejected."""
WRAP_US: Final = 1 << 52
"""Modulus of the time in µs. The lowest 52 bits, converted to ns, fit into int64. They wrap after 142 years."""
MAX_OTHER_MESSAGES: Final = 100
"""Number of consecutive messages without a sample after which a problem is reported."""
MAX_SENDERS: Final = 100
"""Maximum number of senders whose sequence numbers are known."""
MAX_LISTED_SOURCES: Final = 5
"""Maximum number of IMU message sources listed in a problem report."""
UPDATED_BITS: Final = np.array([3, 4, 5, 0, 1, 2])
"""Bits of the field ``fields_updated`` in the order of AXES."""
TEMPERATURE_UPDATED: Final = 1 << 12

CRC_OF_BYTE: Final = frozenset(binascii.crc_hqx(bytes([byte]), 0) for byte in range(256))


@dataclass(frozen=True, slots=True)
class ImuMessage:
    """Layout and units of a message with IMU data."""

    number: int
    crc_extra: int
    layout: np.dtype[np.void]
    time_unit_s: float
    gyro_unit: str
    accel_unit: str
    temperature_unit_c: float


def _build_layout(size: int, **fields: tuple[str, int]) -> np.dtype[np.void]:
    """Return the structured dtype of a payload of ``size`` bytes from the format and offset of each field."""
    formats, offsets = zip(*fields.values(), strict=True)
    return np.dtype({"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": size})


_HIGHRES_LAYOUT = _build_layout(
    63,
    time=("<u8", 0),
    accel=("<3f4", 8),
    gyro=("<3f4", 20),
    temperature=("<f4", 56),
    updated=("<u2", 60),
    instance=("u1", 62),
)
_SCALED_LAYOUT = _build_layout(24, time=("<u4", 0), accel=("<3i2", 4), gyro=("<3i2", 10), temperature=("<i2", 22))
_RAW_LAYOUT = _build_layout(
    29, time=("<u8", 0), accel=("<3i2", 8), gyro=("<3i2", 14), instance=("u1", 26), temperature=("<i2", 27)
)
MESSAGES: Final = {
    "HIGHRES_IMU": ImuMessage(105, 93, _HIGHRES_LAYOUT, 1e-6, "rad/s", "m/s²", 1.0),
    "SCALED_IMU": ImuMessage(26, 170, _SCALED_LAYOUT, 1e-3, "mrad/s", "mg", 0.01),
    "SCALED_IMU2": ImuMessage(116, 76, _SCALED_LAYOUT, 1e-3, "mrad/s", "mg", 0.01),
    "SCALED_IMU3": ImuMessage(129, 46, _SCALED_LAYOUT, 1e-3, "mrad/s", "mg", 0.01),
    "RAW_IMU": ImuMessage(27, 144, _RAW_LAYOUT, 1e-6, "mrad/s", "mg", 0.01),  # units of ArduPilot
}
CRC_EXTRA: Final = {message.number: bytes([message.crc_extra]) for message in MESSAGES.values()}
NAMES: Final = {message.number: name for name, message in MESSAGES.items()}


class Settings(SettingsModel):
    """Keys of ``[device.driver.decoder_options]``."""

    message: Literal["HIGHRES_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3", "RAW_IMU"] = Field(
        "HIGHRES_IMU", description="message with the samples; SCALED_IMU has a resolution of only 1 mrad/s and 1 mg"
    )
    instance: Annotated[int, MAVLINK_ID] = Field(0, description="field id of HIGHRES_IMU or RAW_IMU: 0 = first IMU")
    system: Annotated[int, MAVLINK_ID] = Field(
        0, description="system number of the sender; 0 = sender of the first selected message"
    )
    component: Annotated[int, MAVLINK_ID] = Field(
        0, description="component number of the sender; 0 = sender of the first selected message"
    )
    clock: Literal["device", "arrival"] = Field("device", description="source of the sample times")
    gyro_unit: Annotated[str, checked_by(units.angular_rate_factor)] | None = Field(
        None, examples=["mrad/s"], description='unit of a count of RAW_IMU, such as "mrad/s" or "deg/s/16.4"'
    )
    accel_unit: Annotated[str, checked_by(units.acceleration_factor)] | None = Field(
        None, examples=["mg"], description='unit of a count of RAW_IMU, such as "mg" or "g/2048"'
    )

    def find_conflicting_settings(self) -> Iterator[Conflict]:
        """Yield a conflict for each unit that RAW_IMU lacks."""
        for key, example in (("gyro_unit", '"mrad/s" or "deg/s/16.4"'), ("accel_unit", '"mg" or "g/2048"')):
            if self.message == "RAW_IMU" and getattr(self, key) is None:
                yield Conflict(key, f"missing; RAW_IMU needs the unit of a count, such as {example}")


class MavlinkDecoder(base.FrameStreamDecoder):
    """Decoder of MAVLink 1 and 2 frames, and encoder of MAVLink 2 frames."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(b"", self._match_frame, LONGEST, bytes(HEADER_BYTES))
        self._settings = settings
        self._message = message = MESSAGES[settings.message]
        self._has_instance = "instance" in (message.layout.names or ())
        raw = settings.message == "RAW_IMU"
        self._gyro_factor = units.angular_rate_factor((raw and settings.gyro_unit) or message.gyro_unit)
        self._accel_factor = units.acceleration_factor((raw and settings.accel_unit) or message.accel_unit)
        self._modulus = WRAP_US if message.layout["time"].itemsize == 8 else 1 << 32
        device_clock = settings.clock == "device"
        self.timing: Timing = (
            CounterTimedFormat(self._modulus, message.time_unit_s) if device_clock else ArrivalTimedFormat()
        )
        self._next_sequence = 0  # sequence number of the next encoded frame
        self._forget_sources()

    def _forget_sources(self) -> None:
        self._sender: tuple[int, int] | None = None  # system and component of the selected messages
        self._sequences: dict[tuple[int, int], int] = {}  # last sequence number of each system and component
        self._messages_without_sample = 0  # number of messages since the last sample
        self._sources: dict[str, None] = {}  # sources of IMU messages since the last sample

    @property
    def recent_problem(self) -> str:
        """Reason why samples are missing or frames were rejected; "" if there is no problem."""
        if self._messages_without_sample > MAX_OTHER_MESSAGES:
            sources = "; ".join(self._sources) or "none"
            return f"MAVLink arrives, but no sample of {self._settings.message}; IMU messages that arrive: {sources}"
        return super().recent_problem

    def forget_stream_state(self) -> None:
        """Discard a partially received frame. The next selected message then selects a sender again."""
        super().forget_stream_state()
        self._forget_sources()

    def _decode(self, frames: base.RawFrames) -> list[SampleBlock]:
        rows, payloads, bad_before = [], [], frames.bad_before.tolist()
        for i, frame in enumerate(frames.data):
            bad_before[i] = min(bad_before[i], self._count_missing_frames(frame))
            payload = self._select_payload(frame)
            if payload is not None:
                rows.append(i)
                payloads.append(payload)
        frames = replace(frames, bad_before=np.array(bad_before, np.int64))
        messages = np.frombuffer(b"".join(payloads), self._message.layout)
        blocks, last = self._build_measured_blocks(
            frames.select_frames(rows),
            self._read_values(messages),
            self._read_temperatures(messages),
            self._read_ticks(messages),
        )
        if last is None:
            self._messages_without_sample += len(frames.data)
        else:
            self._messages_without_sample = 0
            self._sources.clear()
        return blocks

    def _count_missing_frames(self, frame: bytes) -> int:
        """Return the number of frames of the sender that are missing before a frame, up to 255."""
        _, system, component, _ = split_frame(frame)
        sequence = frame[4] if frame[0] == VERSION_2 else frame[2]
        if len(self._sequences) >= MAX_SENDERS:
            self._sequences.clear()
        last = self._sequences.get((system, component), sequence)
        self._sequences[system, component] = sequence
        return (sequence - last - 1) % 256

    def _select_payload(self, frame: bytes) -> bytes | None:
        """Return the payload with the omitted zeros restored, or None if the settings do not select the message."""
        number, system, component, payload = split_frame(frame)
        if number not in CRC_EXTRA:
            return None
        layout = MESSAGES[NAMES[number]].layout
        payload = payload.ljust(layout.itemsize, b"\0")[: layout.itemsize]
        instance = np.frombuffer(payload, layout)["instance"][0] if "instance" in (layout.names or ()) else None
        if len(self._sources) < MAX_LISTED_SOURCES:
            text = "" if instance is None else f", instance {instance}"
            self._sources[f"{NAMES[number]} of system {system}, component {component}{text}"] = None
        if number != self._message.number or (instance is not None and instance != self._settings.instance):
            return None
        return payload if self._is_selected_sender(system, component) else None

    def _is_selected_sender(self, system: int, component: int) -> bool:
        if self._sender is None:
            wanted = (self._settings.system or system, self._settings.component or component)
            if wanted != (system, component):
                return False
            self._sender = wanted
        return self._sender == (system, component)

    def _read_values(self, messages: NDArray[np.void]) -> Floats:
        """Return the values [n, 6]. NaN marks an axis that has not been updated since the last message."""
        values = np.empty((len(messages), 6))
        with np.errstate(invalid="ignore"):  # converting a signalling NaN causes a warning
            values[:, :3] = messages["gyro"].astype(np.float64) * self._gyro_factor
            values[:, 3:] = messages["accel"].astype(np.float64) * self._accel_factor
        values = base.nan_to_infinity(values)
        if "updated" in (self._message.layout.names or ()):
            values[messages["updated"][:, None] >> UPDATED_BITS & 1 == 0] = np.nan
        return values

    def _read_temperatures(self, messages: NDArray[np.void]) -> Floats:
        """Return the temperatures [n] in °C. MAVLink sends 0 if the temperature is not measured."""
        with np.errstate(invalid="ignore"):
            raw = messages["temperature"].astype(np.float64)
        return np.where(raw == 0.0, np.nan, raw * self._message.temperature_unit_c)

    def _read_ticks(self, messages: NDArray[np.void]) -> Ints:
        if isinstance(self.timing, ArrivalTimedFormat):
            return np.full(len(messages), NO_TICK, np.int64)
        ticks: Ints = (messages["time"] % np.uint64(self._modulus)).astype(np.int64)
        return ticks

    def _match_frame(self, buffer: bytes, at: int) -> int:
        if len(buffer) < at + 3:
            return base.NEED_MORE if len(buffer) == at or buffer[at] in HEADER_BYTES else base.REJECT
        version, payload_bytes, flags = buffer[at : at + 3]
        if version not in HEADER_BYTES or (version == VERSION_2 and flags & ~SIGNED):
            return base.REJECT
        body_end = at + HEADER_BYTES[version] + payload_bytes
        end = body_end + CRC_BYTES + (SIGNATURE_BYTES if version == VERSION_2 and flags & SIGNED else 0)
        if len(buffer) < end:
            return base.NEED_MORE
        if not has_valid_crc(buffer[at : body_end + CRC_BYTES]):
            return base.REJECT
        self._buffer.sync = buffer[at : at + 1]
        return end - at

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Encode samples as MAVLink 2 frames. Axes that are not measured are 0 and marked as not updated."""
        messages = np.zeros(len(samples), self._message.layout)
        messages["time"] = samples.ticks % self._modulus
        if self._has_instance:
            messages["instance"] = self._settings.instance
        gyro, accel = samples.values[:, :3] / self._gyro_factor, samples.values[:, 3:] / self._accel_factor
        temperature = np.nan_to_num(samples.temperature_c / self._message.temperature_unit_c, nan=0.0)
        if "updated" in (self._message.layout.names or ()):
            messages["gyro"], messages["accel"] = np.nan_to_num(gyro), np.nan_to_num(accel)
            messages["temperature"] = temperature
            measured = np.where(np.isfinite(samples.temperature_c), TEMPERATURE_UPDATED, 0)
            messages["updated"] = measured + (np.isfinite(samples.values) << UPDATED_BITS).sum(axis=1)
        else:
            messages["gyro"], messages["accel"] = base.quantize(gyro, 1.0, 16), base.quantize(accel, 1.0, 16)
            raw = base.quantize(temperature, 1.0, 16)
            # A measured temperature of 0 °C is sent as 0.01 °C, because 0 means that it is not measured.
            messages["temperature"] = np.where((raw == 0) & np.isfinite(samples.temperature_c), 1, raw)
        return base.make_chunks([self._build_frame(message.tobytes()) for message in messages], samples.t_ns)

    def _build_frame(self, payload: bytes) -> bytes:
        payload = payload.rstrip(b"\0") or b"\0"
        system, component = self._settings.system or 1, self._settings.component or 1
        head = bytes([len(payload), 0, 0, self._next_sequence, system, component])
        self._next_sequence = (self._next_sequence + 1) % 256
        body = head + self._message.number.to_bytes(3, "little") + payload
        return bytes([VERSION_2]) + body + compute_crc(body, self._message.crc_extra)


def split_frame(frame: bytes) -> tuple[int, int, int, bytes]:
    """Return the message number, the system, the component and the payload of a valid frame."""
    start = HEADER_BYTES[frame[0]]
    payload = frame[start : start + frame[1]]
    if frame[0] == VERSION_2:
        return int.from_bytes(frame[7:10], "little"), frame[5], frame[6], payload
    return frame[5], frame[3], frame[4], payload


def compute_crc(body: bytes, crc_extra: int) -> bytes:
    """Return the two CRC bytes of a frame.

    Parameters
    ----------
    body
        Bytes of the frame from its second byte to the end of the payload.
    crc_extra
        Byte that depends on the message.
    """
    mirrored = (body + bytes([crc_extra])).translate(base.BIT_REVERSAL)
    return binascii.crc_hqx(mirrored, 0xFFFF).to_bytes(2, "big").translate(base.BIT_REVERSAL)


def has_valid_crc(frame: bytes) -> bool:
    """Return True if the CRC of a frame without signature is correct.

    If the message contains no IMU data, the CRC is accepted if any value of CRC_EXTRA yields it.
    """
    # crc_hqx computes an unreflected CRC, but the CRC of MAVLink is reflected. All bytes are therefore bit-reversed.
    mirrored = frame[1:].translate(base.BIT_REVERSAL)
    crc, stated = binascii.crc_hqx(mirrored[:-2], 0xFFFF), int.from_bytes(mirrored[-2:], "big")
    crc_extra = CRC_EXTRA.get(split_frame(frame)[0])
    if crc_extra is None:
        return stated ^ (crc << 8 & 0xFF00) in CRC_OF_BYTE
    return binascii.crc_hqx(crc_extra.translate(base.BIT_REVERSAL), crc) == stated


def build(settings: Settings) -> base.Decoder:
    """Return a MAVLink decoder with the given settings."""
    return MavlinkDecoder(settings)
