"""Conversion between ``SampleBlock`` and the msgpack map that is published under ``<prefix>/<device>/samples``.

``docs/reference/samples-format.md`` documents the format. The daemon and the replay of a recording write these
messages, and the decoder ``samples`` reads them.

If the samples are evenly spaced to within half a microsecond, ``t0`` and ``t`` are the Unix times of the first and the
newest sample in seconds, and ``rate`` is the sample rate in Hz. Otherwise, ``t`` contains the Unix time of each sample
in seconds as little-endian float64, with a resolution of 0.24 µs. Unknown keys and columns are ignored. A message whose
sizes are inconsistent or too large raises ``DecodeError``.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final

import msgspec
import numpy as np

from drivers.data_types import AXES, Floats, Ints, SampleBlock, make_block, ns_to_seconds, seconds_to_ns
from drivers.errors import DecodeError

SCHEMA: Final = "imu-monitor/samples/1"
SCHEMAS: Final = (SCHEMA, "imu-monitor/compensated/1")
"""Names of all schemas that use this message format."""
TEMPERATURE: Final = "temperature"
COLUMNS: Final = (*AXES, TEMPERATURE)
MAX_ROWS: Final = 1_000_000
MAX_COLUMNS: Final = 64
MAX_BYTES: Final = 1 << 26  # enough for a million samples with seven columns
MAX_GRID_DEVIATION_NS: Final = 500
"""Maximum deviation in ns of a sample time from an evenly spaced grid.

The value is twice the resolution of Unix seconds in float64.
"""
T_LIMIT_S: Final = 4.6e9
"""Largest absolute Unix time in s (years 1824 to 2115). The difference of two times fits into int64 nanoseconds."""
RATE_LIMITS_HZ: Final = (1e-6, 1e9)

Count = Annotated[int, msgspec.Meta(ge=0, le=1 << 53)]
Lost = Annotated[int, msgspec.Meta(ge=0, le=1_000_000_000)]
"""Number of lost samples. The maximum corresponds to eleven days at 1 kHz."""


class _Payload(msgspec.Struct, frozen=True, omit_defaults=True):
    schema: str
    axes: list[str]
    data: bytes
    t: float | bytes
    samples: Count
    device: str = ""
    lost: Lost = 0
    t0: float | None = None
    rate: float | None = None


_ENCODER: Final = msgspec.msgpack.Encoder()
_DECODER: Final = msgspec.msgpack.Decoder(_Payload)


@dataclass(frozen=True, slots=True)
class DecodedSampleMessage:
    """Decoded content of one sample message."""

    device: str
    total_samples: int  # samples that the publisher has received since its start, including this message
    block: SampleBlock  # t_ns are Unix times


def encode_samples(
    device: str, total_samples: int, block: SampleBlock, unix_offset_ns: Ints | int = 0, schema: str = SCHEMA
) -> bytes:
    """Encode samples as one message.

    Parameters
    ----------
    device
        Name of the device.
    total_samples
        Number of samples received from the device since the start, including the samples in the message.
    block
        Samples to encode. Axes that contain only NaN are omitted. If all values are NaN, the message contains all six
        axes.
    unix_offset_ns
        Offset from ``t_ns`` to Unix time in ns.
    schema
        Name of the message schema.
    """
    without_axis: Any = np.isnan(block.values).all(axis=0)
    missing = [*without_axis.tolist(), bool(np.isnan(block.temperature_c).all())]
    measured = [column for column in range(len(COLUMNS)) if not missing[column]] or [*range(len(AXES))]
    table = block.values.astype("<f8", copy=False)
    if len(measured) != len(AXES) or not missing[-1]:
        table = np.column_stack((block.values, block.temperature_c))[:, measured].astype("<f8", copy=False)
    t: float | bytes
    t, t0, rate = _encode_times(block.t_ns + unix_offset_ns)
    return _ENCODER.encode(
        _Payload(
            schema=schema,
            device=device,
            axes=[COLUMNS[column] for column in measured],
            data=table.tobytes(),
            t=t,
            samples=total_samples,
            lost=block.lost,
            t0=t0,
            rate=rate,
        )
    )


def decode_samples(data: bytes) -> DecodedSampleMessage:
    """Decode the samples of one message. Raise DecodeError if the message is invalid."""
    try:
        payload = _DECODER.decode(data)
    except (msgspec.DecodeError, msgspec.ValidationError, UnicodeDecodeError, RecursionError) as error:
        raise DecodeError(f"no samples message: {error}") from error
    if payload.schema not in SCHEMAS:
        raise DecodeError(f'schema "{payload.schema[:64]}" is not {SCHEMA}')
    table = _decode_values(payload)
    t_ns = _decode_times_ns(payload, table.shape[0])
    values = np.full((t_ns.size, len(AXES)), np.nan)
    temperature_c = np.full(t_ns.size, np.nan)
    for column, name in zip(table.T, payload.axes, strict=True):
        if name == TEMPERATURE:
            temperature_c = column.copy()
        elif name in AXES:
            values[:, AXES.index(name)] = column
    rows = make_block(t_ns, values, temperature_c, lost=payload.lost)
    return DecodedSampleMessage(payload.device, payload.samples, rows)


def _encode_times(unix_ns: Ints) -> tuple[float | bytes, float | None, float | None]:
    n = unix_ns.size
    span_ns = int(unix_ns[-1] - unix_ns[0])
    rate = (n - 1) * 1e9 / span_ns if span_ns > 0 else 0.0
    if RATE_LIMITS_HZ[0] <= rate <= RATE_LIMITS_HZ[1]:
        grid = unix_ns[0] + np.rint(np.arange(n) * (span_ns / (n - 1))).astype(np.int64)
        if np.abs(unix_ns - grid).max() <= MAX_GRID_DEVIATION_NS:
            return float(unix_ns[-1]) * 1e-9, float(unix_ns[0]) * 1e-9, rate
    return ns_to_seconds(unix_ns).astype("<f8").tobytes(), None, None


def _decode_values(payload: _Payload) -> Floats:
    names: Sequence[str] = payload.axes
    if not 0 < len(names) <= MAX_COLUMNS or len(set(names)) != len(names):
        raise DecodeError(f"axes: {len(names)} names, expected 1 to {MAX_COLUMNS} different names")
    if len(payload.data) > MAX_BYTES:
        raise DecodeError(f"data: {len(payload.data)} bytes, expected at most {MAX_BYTES}")
    n, rest = divmod(len(payload.data), 8 * len(names))
    if rest or not 0 < n <= MAX_ROWS:
        raise DecodeError(f"data: {len(payload.data)} bytes, expected 1 to {MAX_ROWS} rows of {len(names)} float64")
    return np.frombuffer(payload.data, "<f8").reshape(n, len(names)).astype(np.float64)


def _decode_times_ns(payload: _Payload, n: int) -> Ints:
    if isinstance(payload.t, bytes):
        if len(payload.t) != 8 * n:
            raise DecodeError(f"t: {len(payload.t)} bytes for {n} rows, expected one float64 per row")
        seconds = np.frombuffer(payload.t, "<f8").astype(np.float64)
        _check_times(seconds)
        return seconds_to_ns(seconds)
    t0, rate = payload.t0, payload.rate
    if t0 is None or rate is None:
        if n > 1:
            raise DecodeError("t is one number, so t0 and rate must be given")
        t0, rate = payload.t, 1.0
    if not RATE_LIMITS_HZ[0] <= rate <= RATE_LIMITS_HZ[1]:
        raise DecodeError(f"rate: {rate:g} Hz is not a sample rate")
    _check_times(np.array([t0, t0 + (n - 1) / rate]))
    steps: Ints = np.rint(np.arange(n) * (1e9 / rate)).astype(np.int64)
    first: Ints = seconds_to_ns(np.array([t0]))
    return first + steps


def _check_times(seconds: Floats) -> None:
    if not np.all(np.abs(seconds) < T_LIMIT_S):
        raise DecodeError("t: a time is not a Unix time in seconds")
