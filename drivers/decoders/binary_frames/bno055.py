"""Bosch BNO055 over UART, 115200 baud, which sends data only as an answer to a request.

The request ``AA 01 00 3C`` reads the registers 0x00 to 0x3B, and the answer is ``BB 3C | 60 bytes``, little-endian.
Sources: data sheet BST-BNO055-DS000-14, sections 3.6, 4.3 and 4.7; register 0x3C is reserved.

======== ==============================================================================================================
register content
======== ==============================================================================================================
0x00     identifiers of the chip and its sensors, A0 FB 32 0F
0x07     register page, 0
0x08     acceleration 3 x i16, 100 LSB for 1 m/s² or 1 LSB for 1 mg
0x0E     magnetic field 3 x i16, not read
0x14     angular rate 3 x i16, 16 LSB for 1 °/s or 900 LSB for 1 rad/s
0x34     temperature i8, 1 LSB for 1 °C or for 2 °F
0x39     SYS_STATUS: 1 error, 5 running with sensor fusion, 6 running without sensor fusion
0x3A     SYS_ERR: reason of the status 1
0x3B     UNIT_SEL: bit 0 mg, bit 1 rad/s, bit 4 °F; the default 0 in these bits means m/s², °/s and °C
======== ==============================================================================================================

The answers have no checksum. The identifiers, the page and the length serve as a check. Each answer contains the units,
so the decoder has no options. With sensor fusion, the rates and accelerations are corrected by the estimated offsets.
After power-on, the sensor is in CONFIGMODE, and all measurements are 0. These answers make no samples.

The sensor sends ``EE code`` when it cannot answer a read request, and also to acknowledge a write request. The codes 1
and 3 acknowledge a write request. Each other code is a missing sample. The most frequent one is 7, BUS_OVER_RUN_ERROR,
for which the manufacturer recommends repeating the request. The answers are timed by their arrival.
"""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import NO_TICK, ArrivalTimedFormat, Chunk, Floats, SampleBlock, Timing
from drivers.decoders import base
from drivers.units import DEGREE, G0
from drivers.validation.settings_model import SettingsModel

REGISTER_COUNT: Final = 0x3C
HEADER: Final = b"\xbb" + bytes([REGISTER_COUNT]) + b"\xa0\xfb\x32\x0f"
PAGE_AT: Final = 2 + 0x07
"""Offset of the register page in an answer."""
LENGTH: Final = 2 + REGISTER_COUNT
LAYOUT: Final = np.dtype(
    {
        "names": ["header", "accel", "gyro", "temperature", "status", "error", "units"],
        "formats": ["S6", ("<i2", 3), ("<i2", 3), "i1", "u1", "u1", "u1"],
        "offsets": [0, *(2 + register for register in (0x08, 0x14, 0x34, 0x39, 0x3A, 0x3B))],
        "itemsize": LENGTH,
    }
)
ERROR: Final = b"\xee"
ERROR_CODES: Final = range(1, 11)
"""Codes of error answers in the data sheet."""
WRITE_CODES: Final = (1, 3)
"""Codes that answer a write request."""
MAX_ERROR_BYTES: Final = 20
"""Maximum number of bytes of consecutive error answers to decode before waiting for an answer with registers."""
SYSTEM_ERROR, FUSION_RUNNING, RUNNING = 1, 5, 6
"""Values of SYS_STATUS."""
ACCEL_STEPS: Final = np.array([0.01, 1e-3 * G0])
"""Value of 1 LSB in m/s² without and with the unit bit."""
GYRO_STEPS: Final = np.array([DEGREE / 16.0, 1.0 / 900.0])
"""Value of 1 LSB in rad/s without and with the unit bit."""


class Settings(SettingsModel):
    """Settings of the decoder. There are no options."""


class Bno055Decoder(base.FrameStreamDecoder):
    """Decoder and encoder of answers with the registers 0x00 to 0x3B."""

    timing: Timing = ArrivalTimedFormat(answers_requests=True)

    def __init__(self) -> None:
        super().__init__(b"", _match_answer, MAX_ERROR_BYTES + LENGTH, ERROR + HEADER[:1])
        self._missed = 0  # number of read requests that were answered with an error
        self._last_error = 0  # code of the last error answer; 0 if an answer with registers followed
        self._status = self._system_error = 0

    @property
    def bad(self) -> int:
        """Number of rejected answers. Requests answered with an error are counted as missing, not as rejected."""
        return super().bad - self._missed

    @property
    def recent_problem(self) -> str:
        """Error that the sensor reports, or reason why there are no samples; "" if there is no problem."""
        if self._status == SYSTEM_ERROR:
            return f"the sensor reports the system error {self._system_error} in SYS_ERR"
        if self._last_error:
            return f"the sensor answers only with the error {self._last_error}: is the request AA 01 00 3C?"
        if self._lacks_samples:
            return "the sensor does not measure: select a mode, for example with the first request AA 00 3D 01 05"
        return super().recent_problem

    @property
    def on_board_filter_note(self) -> str:
        """Note which says that sensor fusion has corrected the samples; "" if fusion is off."""
        return base.ON_BOARD_FILTER_NOTE if self._status == FUSION_RUNNING else ""

    def _decode(self, frames: base.RawFrames) -> list[SampleBlock]:
        missed = np.array([_count_missed_samples(frame) for frame in frames.data], np.int64)
        self._missed += int(missed.sum())
        self._last_error = frames.data[-1][-1] if len(frames.data[-1]) < LENGTH else 0
        answers = [i for i, frame in enumerate(frames.data) if len(frame) >= LENGTH]
        frames = replace(frames, bad_before=frames.bad_before + missed).select_frames(answers)
        registers = np.frombuffer(b"".join(frame[-LENGTH:] for frame in frames.data), LAYOUT)
        if registers.size:
            self._status, self._system_error = int(registers["status"][-1]), int(registers["error"][-1])
        values, temperature_c = _read_measurements(registers)
        return self._build_measured_blocks(frames, values, temperature_c, np.full(len(answers), NO_TICK))[0]

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Encode each sample as the answer of a sensor without sensor fusion. Axes without a value are 0."""
        rows = np.zeros(len(samples), LAYOUT)
        rows["header"], rows["status"] = HEADER, RUNNING
        rows["gyro"] = base.quantize(samples.values[:, :3], GYRO_STEPS[0], 16)
        rows["accel"] = base.quantize(samples.values[:, 3:], ACCEL_STEPS[0], 16)
        rows["temperature"] = base.quantize(samples.temperature_c, 1.0, 8)
        return base.make_chunks([row.tobytes() for row in rows], samples.t_ns)


def _read_measurements(registers: NDArray[np.void]) -> tuple[Floats, Floats]:
    """Return the values [n, 6] and the temperatures [n] in °C.

    The values are NaN if the sensor has no measurement, and infinite if it reports an error.
    """
    units = registers["units"]
    gyro = registers["gyro"] * GYRO_STEPS[units >> 1 & 1][:, None]
    accel = registers["accel"] * ACCEL_STEPS[units & 1][:, None]
    values = np.hstack([gyro, accel])
    values[~values.any(axis=1)] = np.nan
    values[registers["status"] == SYSTEM_ERROR] = np.inf
    temperature = registers["temperature"].astype(np.float64)
    return values, np.where(units >> 4 & 1, (2.0 * temperature - 32.0) / 1.8, temperature)


def _count_missed_samples(frame: bytes) -> int:
    """Return the number of read requests that were answered with an error before the answer with registers."""
    errors = frame[:-LENGTH] if len(frame) >= LENGTH else frame
    return sum(code not in WRITE_CODES for code in errors[1::2])


def _match_answer(buffer: bytes, at: int) -> int:
    """Match error answers and the answer with registers that follows them, or MAX_ERROR_BYTES of error answers."""
    start = at
    while buffer[start : start + 1] == ERROR and start + 1 < len(buffer):
        if buffer[start + 1] not in ERROR_CODES:
            return base.REJECT
        start += 2
        if start - at == MAX_ERROR_BYTES:
            return MAX_ERROR_BYTES
    answer = buffer[start : start + LENGTH]
    if answer != ERROR and not HEADER.startswith(answer[: len(HEADER)]):
        return base.REJECT
    if len(answer) < LENGTH:
        return base.NEED_MORE
    # The header of the next answer lies inside a truncated answer.
    return base.REJECT if answer[PAGE_AT] or HEADER in answer[1:] else start + LENGTH - at


def build(settings: Settings) -> base.Decoder:
    """Return a decoder of answers with registers."""
    return Bno055Decoder()
