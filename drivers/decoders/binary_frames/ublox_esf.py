"""u-blox receivers with an inertial sensor (NEO-M8U, NEO-M8L, ZED-F9R, ZED-F9K): UBX-ESF-RAW and UBX-ESF-MEAS.

The format is ``B5 62 | class u8 | ID u8 | length u16 | payload | CK_A CK_B``, little-endian. The two checksum bytes are
the Fletcher-8 sums over class, ID, length and payload. Other UBX messages and NMEA sentences are ignored. Bytes of
other protocols, such as RTCM, count as lost messages. Payloads:

- ESF-MEAS (10 02): ``time tag u32 in ms | flags u16 | id u16 | measurements u32``. If bit 3 of the flags is set, the
  last u32 is a calibrated time tag and not a measurement.
- ESF-RAW (10 03): 4 bytes that are ignored, then pairs of ``measurement u32 | sensor time tag u32``.

Bits 24 to 29 of a measurement are its type, and bits 0 to 23 a signed number. Types 14, 13 and 5 contain the x, y and z
angular rates in units of 2^-12 °/s. Types 16, 17 and 18 are the accelerations x, y and z in 2^-10 m/s². Type 12 is the
temperature of the gyroscope in 0.01 °C. Other types are wheel speeds and are ignored. Sources: u-blox 8/M8 receiver
description UBX-13003221, ZED-F9K integration manual (table 11), pyubx2.

A sample is complete if all six axes have arrived. In ESF-MEAS, the gyroscope and the accelerometer values are sent in
separate messages. Their time tags are equal in published messages of a ZED-F9R, but 5 ms apart in the recorded messages
of pyubx2. The key ``window`` sets the largest time difference allowed within a sample. All measurements of one sample
in ESF-RAW have the same tag.

u-blox does not specify the unit of the sensor time tag in ESF-RAW. The converter of Swift Navigation uses 39.0625 µs
and 24 bits for a NEO-M8L. The decoder therefore uses the low 24 bits. Unless the key ``tick`` states the duration of
one unit, only the number of units between two samples is known.
"""

import math
import re
import struct
from collections.abc import Iterator
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field

from drivers.data_types import NO_TICK, ArrivalTimedFormat, Chunk, CounterTimedFormat, SampleBlock, Timing
from drivers.decoders import base
from drivers.units import DEGREE
from drivers.validation.number_ranges import DELAY_S, TICK_S
from drivers.validation.settings_model import SettingsModel

SYNC: Final = b"\xb5\x62"
MESSAGES: Final = {"esf-raw": b"\x10\x03", "esf-meas": b"\x10\x02"}
CLASSES: Final = bytes.fromhex("01 02 04 05 06 09 0A 0B 0D 10 13 21 27 28 29")
"""Classes of all messages of u-blox receivers, from NAV to NAV2."""
MAX_PAYLOAD: Final = 4096
"""Maximum payload in bytes. The largest message of a receiver, RXM-RAWX, is about 3 kB long."""
LONGEST: Final = 8 + MAX_PAYLOAD
SENTENCE: Final = re.compile(rb"\$([ -)+-~]{1,200})\*([0-9A-F]{2})\r\n")
"""NMEA sentence, with groups for its content and its checksum."""
START_OF_SENTENCE: Final = re.compile(rb"\$[ -~]{0,203}\r?")

GYRO_STEP: Final = DEGREE / 2**12
ACCEL_STEP: Final = 2.0**-10
TEMPERATURE_STEP: Final = 0.01
STEPS: Final = np.repeat([GYRO_STEP, ACCEL_STEP], 3)
AXIS_TYPES: Final = (14, 13, 5, 16, 17, 18)
"""Types of the measurements in the order of ``AXES``."""
COLUMNS: Final = {kind: column for column, kind in enumerate(AXIS_TYPES)}
TEMPERATURE_TYPE: Final = 12
CALIBRATED_TAG: Final = 1 << 3
MODULI: Final = {"esf-raw": 1 << 24, "esf-meas": 1 << 32}
MAX_MESSAGES_WITHOUT_SAMPLE: Final = 100
"""Number of messages without a complete sample after which a problem is reported."""


class Settings(SettingsModel):
    """Keys of ``[device.driver.decoder_options]``."""

    message: Literal["esf-raw", "esf-meas"] = Field("esf-raw", description="message with the measurements")
    window: Annotated[float, DELAY_S] = Field(
        0.005, description="largest difference in s between the time tags of one sample in ESF-MEAS"
    )
    tick: Annotated[float, TICK_S] | None = Field(
        None, examples=[39.0625e-6], description="unit of the time tags in ESF-RAW in s; absent: unknown unit"
    )
    clock: Literal["time_tag", "arrival"] = Field("time_tag", description="source of the sample times")


class UbloxEsfDecoder(base.FrameStreamDecoder):
    """Decoder and encoder of ESF-RAW and ESF-MEAS messages."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(b"", _match_message, LONGEST, SYNC[:1] + b"$")
        self._name = settings.message
        self._modulus = MODULI[settings.message]
        tick_s = 1e-3 if settings.message == "esf-meas" else settings.tick
        self._window_s = settings.window
        self._window = math.floor(settings.window / 1e-3 + 1e-6) if settings.message == "esf-meas" else 0
        self.timing: Timing = ArrivalTimedFormat()
        if settings.clock == "time_tag":
            self.timing = CounterTimedFormat(self._modulus, tick_s)
        self._temperature_c = math.nan
        self._forget_assembly_state()

    def _forget_assembly_state(self) -> None:
        self._partial: dict[int, int] = {}  # measurements of the incomplete sample by column
        self._tag = NO_TICK  # time tag of the first of these measurements
        self._rejected = 0  # number of rejected frames since the last sample
        self._dropped = 0  # number of incomplete samples since the last sample
        self._synchronized = False  # True after the first sample
        self._messages_without_sample = 0
        self._other_message = ""

    def forget_stream_state(self) -> None:
        """Discard a partially received message and an incomplete sample."""
        super().forget_stream_state()
        self._forget_assembly_state()

    @property
    def recent_problem(self) -> str:
        """Reason why there are no samples; "" if there is no problem."""
        if self._other_message:
            return (
                f"{self._other_message.upper()} arrives, not {self._name.upper()}: "
                f'set message = "{self._other_message}"'
            )
        if self._messages_without_sample >= MAX_MESSAGES_WITHOUT_SAMPLE:
            within = f" within window = {self._window_s:g} s" if self._name == "esf-meas" else " with equal time tags"
            return f"measurements arrive, but never all six axes{within}"
        return super().recent_problem

    def _decode(self, frames: base.RawFrames) -> list[SampleBlock]:
        rows: list[list[int]] = []
        at, ticks, missing, temperatures_c = [], [], [], []
        for i, frame in enumerate(frames.data):
            self._rejected += int(frames.bad_before[i])
            if not self._is_measurement_message(frame):
                continue
            for tag, word in _read_measurements(frame):
                if not self._add_measurement(tag & (self._modulus - 1), word):
                    continue
                rows.append([self._partial[column] for column in range(6)])
                at.append(i)
                ticks.append(self._tag)
                temperatures_c.append(self._temperature_c)
                missing.append(max(self._rejected, self._dropped) if self._synchronized else 0)
                self._partial = {}
                self._rejected = self._dropped = self._messages_without_sample = 0
                self._synchronized = True
        values = np.array(rows, np.float64).reshape(-1, 6) * STEPS
        return self._builder.build_plausible_blocks(
            frames.t_ns[at],
            values,
            np.array(temperatures_c, np.float64),
            np.array(ticks, np.int64) if isinstance(self.timing, CounterTimedFormat) else None,
            np.array(missing, np.int64),
        )

    def _is_measurement_message(self, frame: bytes) -> bool:
        """Return True if a frame is the configured message, and note if it is the other one."""
        wanted = frame[2:4] == MESSAGES[self._name]
        if wanted:
            self._messages_without_sample += 1
            self._other_message = ""
        elif not self._synchronized:
            names = [name for name, code in MESSAGES.items() if frame[2:4] == code]
            self._other_message = names[0] if names else self._other_message
        return wanted

    def _add_measurement(self, tag: int, word: int) -> bool:
        """Add a measurement to the incomplete sample. Return True if the sample is now complete."""
        kind = word >> 24 & 0x3F
        number = (word & 0xFFFFFF ^ 0x800000) - 0x800000
        if kind == TEMPERATURE_TYPE:
            self._temperature_c = number * TEMPERATURE_STEP
        column = COLUMNS.get(kind)
        if column is None:
            return False
        distance = min((tag - self._tag) % self._modulus, (self._tag - tag) % self._modulus)
        if self._partial and (column in self._partial or distance > self._window):
            self._partial = {}
            self._dropped += 1
        if not self._partial:
            self._tag = tag
        self._partial[column] = number
        return len(self._partial) == len(COLUMNS)

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Encode each sample as one message. Axes that are not measured are sent as 0."""
        raw = base.quantize(samples.values / STEPS, 1.0, 24) & 0xFFFFFF
        warmth = base.quantize(samples.temperature_c, TEMPERATURE_STEP, 24) & 0xFFFFFF
        has_temperature = np.isfinite(samples.temperature_c)
        frames = []
        for row, number, has, tick in zip(raw.tolist(), warmth.tolist(), has_temperature, samples.ticks, strict=True):
            words = [TEMPERATURE_TYPE << 24 | number] if has else []
            words += [kind << 24 | value for kind, value in zip(AXIS_TYPES, row, strict=True)]
            tag = int(tick) % self._modulus
            if self._name == "esf-meas":
                payload = struct.pack(f"<IHH{len(words)}I", tag, len(words) << 11, 0, *words)
            else:
                payload = bytes(4) + b"".join(struct.pack("<II", word, tag) for word in words)
            frames.append(encode_message(MESSAGES[self._name], payload))
        return base.make_chunks(frames, samples.t_ns)


def _read_measurements(frame: bytes) -> Iterator[tuple[int, int]]:
    """Yield the time tag and the word of each measurement of an ESF-RAW or ESF-MEAS message."""
    payload = frame[6:-2]
    if frame[2:4] == MESSAGES["esf-raw"]:
        for word, tag in struct.iter_unpack("<II", payload[4:]):
            yield tag, word
        return
    tag, flags = struct.unpack_from("<IH", payload)
    end = len(payload) - (4 if flags & CALIBRATED_TAG else 0)
    for (word,) in struct.iter_unpack("<I", payload[8:end]):
        yield tag, word


def encode_message(code: bytes, payload: bytes) -> bytes:
    """Return a UBX message.

    Parameters
    ----------
    code
        Class and ID.
    payload
        Content of at most 65535 bytes.
    """
    body = code + len(payload).to_bytes(2, "little") + payload
    return SYNC + body + base.fletcher_checksum(body)


def _match_message(buffer: bytes, at: int) -> int:
    start = buffer[at : at + 2]
    if start[:1] == b"$":
        return _match_sentence(buffer, at)
    if not SYNC.startswith(start):
        return base.REJECT
    if len(buffer) < at + 6:
        return base.NEED_MORE
    length = int.from_bytes(buffer[at + 4 : at + 6], "little")
    if not _is_possible_length(buffer[at + 2 : at + 4], length):
        return base.REJECT
    end = at + 8 + length
    if len(buffer) < end:
        return base.NEED_MORE
    return end - at if base.fletcher_checksum(buffer[at + 2 : end - 2]) == buffer[end - 2 : end] else base.REJECT


def _is_possible_length(code: bytes, length: int) -> bool:
    if code == MESSAGES["esf-raw"]:
        return length >= 4 and length % 8 == 4 and length <= MAX_PAYLOAD
    if code == MESSAGES["esf-meas"]:
        return length >= 8 and length % 4 == 0 and length <= MAX_PAYLOAD
    return code[0] in CLASSES and length <= MAX_PAYLOAD


def _match_sentence(buffer: bytes, at: int) -> int:
    whole = SENTENCE.match(buffer, at)
    if whole is not None:
        return whole.end() - at if base.xor_checksum(whole[1]) == int(whole[2], 16) else base.REJECT
    start = START_OF_SENTENCE.match(buffer, at)
    return base.NEED_MORE if start is not None and start.end() == len(buffer) else base.REJECT


def build(settings: Settings) -> base.Decoder:
    """Return a decoder of ESF messages with the given settings."""
    return UbloxEsfDecoder(settings)
