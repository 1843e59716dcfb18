"""Fuzz targets of data from other processes: zenoh messages, JSON files of other commands, and command lines."""

import math
from collections.abc import Iterator
from dataclasses import fields
from functools import cache
from typing import Final

import msgspec
import numpy as np
from rich.console import Console

from drivers.errors import ConfigError, DecodeError, ImuError
from drivers.zenoh.sample_message import decode_samples, encode_samples
from monitor.cli.shared import options
from monitor.commands import thermal
from monitor.common import topics
from monitor.publishing.exporters import FORMATS, export, from_analysis_json
from monitor.publishing.remote_device_states import RemoteDeviceRegistry
from monitor.publishing.terminal.live_device_table import device_overview
from monitor.publishing.zenoh.subscriber import ZenohSubscriber
from monitor.settings import loading
from monitor.simulator.effect_option_parser import parse_effects
from tests.experiments.fuzz.checks import check_error_message
from tests.experiments.fuzz.input_reader import InputReader
from tests.experiments.fuzz.target import target
from tests.experiments.fuzz.targets.decoders import build_message, build_samples
from tests.experiments.fuzz.targets.files import get_folder
from tests.experiments.fuzz.targets.settings import check_finite

# --- messages of daemons

LETTER: Final = {"status": "estimated", "value": 1e-4, "lo": 9e-5, "hi": 1.1e-4}
HEADS: Final = {"device": "a", "t": 1.7e9, "samples": 100}
MESSAGES: Final = {
    topics.STATUS: {
        "state": "running", "received": 100, "lost": 2, "bad": 1, "rate": 99.9, "overflowed": 0, "text": "",
        "latency": {"p50": 1e-3, "p99": 2e-3}, "outputs": {"zenoh": "ok", "viewer": "stalled"},
    },
    topics.COEFFICIENTS: {
        "axes": {a: {"N": LETTER, "R": {"status": "upper_bound", "hi": 1.0}} for a in ("gz", "ax")}, "rate": 100.0,
        "window": 3600.0, "filled": 10.0,
    },
    topics.EVENT: {"kind": "noise_changed", "text": "gz rose", "axis": "gz", "what": {"N": {"before": 1.0}}},
    topics.GAP: {"axes": {"gz": {"gap": 3.0, "where": {"tau": [0.1, 1.0]}, "agrees": False}}},
}  # fmt: skip
NAMES: Final = tuple(topic.name for topic in MESSAGES)
WORDS: Final = (
    '"schema"', '"imu-monitor/status/1"', '"axes"', '"gz"', "null", "true", "1e999", "-1", "1e308", '"\\u001b[2J"',
    "[", "{", "\xff", "[" * 30, '"\\ud800"', '"text":', '"upper_bound"', '"unestimated"', '"outputs":{',
)  # fmt: skip


@cache
def _payloads() -> tuple[bytes, ...]:
    return tuple(msgspec.json.encode({"schema": topic.schema_name(), **HEADS, **m}) for topic, m in MESSAGES.items())


def _message_seeds() -> Iterator[bytes]:
    for i, payload in enumerate(_payloads()):
        yield bytes([i]) + payload
        yield bytes([i]) + payload[:-1] + b',"x":' + b"[" * 1200


def _process_message(data: bytes) -> RemoteDeviceRegistry:
    registry = RemoteDeviceRegistry(lambda: 1.0)
    name = NAMES[data[0] % len(NAMES)] if data else "status"
    registry.process_message(f"imu/a/{name}", data[1:])
    return registry


@target("daemon-message", _message_seeds, 2000, WORDS)
def daemon_message(data: bytes) -> None:
    """Check that a message of a daemon is processed or counted as malformed."""
    registry = _process_message(data)
    assert registry.malformed in (0, 1)


@target("device-table", _message_seeds, 2000, WORDS)
def device_table(data: bytes) -> None:
    """Check that the table of devices can show a device after any message."""
    console = Console(width=100, height=30, file=_CheckedTerminal(), force_terminal=True)
    console.print(device_overview(_process_message(data), 2.0))


class _CheckedTerminal:
    """Terminal that fails if it receives a control character."""

    encoding = "utf-8"

    def write(self, text: str) -> int:
        assert "\x1b[2J" not in text, "a control character reached the terminal"
        return len(text)

    def flush(self) -> None:
        """Do nothing, because there is no buffer."""


@target(
    "samples-message",
    lambda: [encode_samples("a", 3, build_samples(bytes(range(24)), _UntimedDecoder())), bytes(range(80))],
    600,
)
def samples_message(data: bytes) -> None:
    """Check that a decoded message is the same after it has been encoded and decoded again."""
    if data[:1] < b"\x40":
        data = build_message(InputReader(data))
    try:
        batch = decode_samples(data)
    except DecodeError as error:
        check_error_message(error)
        return
    rows = batch.block
    assert (np.abs(rows.t_ns) < 1 << 62).all()
    if (np.diff(rows.t_ns) > 0).all():
        decoded_again = decode_samples(encode_samples(batch.device, batch.total_samples, rows)).block
        assert np.array_equal(decoded_again.values, rows.values, equal_nan=True)
        assert np.abs(decoded_again.t_ns - rows.t_ns).max() <= 1100, "the times have changed"


class _UntimedDecoder:
    timing = None


# --- files of other commands


def _analysis_seeds() -> Iterator[bytes]:
    axes = {axis: {"allan": {"tau": [1.0]}, "coefficients": dict.fromkeys("QNBKR", LETTER)} for axis in ("gx", "az")}
    yield msgspec.json.encode(
        {"schema": "imu-monitor/analyze/1", "rate": 100.0, "samples": 9, "axes": axes, "notes": []}
    )
    yield b'{"x":' + b"[" * 2000


@target("analysis", _analysis_seeds, 2500, (*WORDS, '"coefficients"', '"imu-monitor/analyze/1"'))
def analysis(data: bytes) -> None:
    """Check the export of a file of ``analyze --json`` in every format."""
    try:
        noise = from_analysis_json(data)
    except ConfigError as error:
        check_error_message(error)
        return
    for form in FORMATS:
        try:
            text = export(noise, form)
        except ImuError as error:
            check_error_message(error)
        else:
            assert "nan" not in text.lower().replace("nanosec", ""), text


def _thermal_seeds() -> Iterator[bytes]:
    row = {
        "powers": 1, "time_constants": [60.0], "reference": 25.0, "sizes": [0.0, 1e-5, 1e-6], "start": [0.1],
        "phi": 0.5, "sigma": 1e-6, "covariance": np.eye(5).tolist(), "temperature": [20.0, 40.0],
    }  # fmt: skip
    yield msgspec.json.encode({"schema": thermal.SCHEMA, "interval": 10.0, "axes": {"gz": row}})
    yield b'{"x":' + b"[" * 2000


@target("thermal-model", _thermal_seeds, 2500, (*WORDS, '"covariance":[[1,2],[3]]', '"powers":', "[0.5]", "[[", "]]"))
def thermal_model(data: bytes) -> None:
    """Check a model file of ``thermal fit``."""
    path = get_folder() / "thermal.json"
    path.write_bytes(data)
    try:
        models = thermal.read_model_file(path)
    except ConfigError as error:
        check_error_message(error)
        return
    for model in models.values():
        n = model.coefficients.size
        assert model.interval_s > 0.0
        assert model.covariance.shape == (n + 2 * model.initial_state.size,) * 2
        assert np.isfinite(model.coefficients).all()
        assert np.isfinite(model.covariance).all()


# --- command line


def _text(data: bytes) -> str:
    return data.decode("utf-8", "surrogateescape")


@target(
    "effects",
    (b"gz.sinusoidal:amplitude=1e-3,frequency=17", b"g*.bias:value=1", b"gz.g_sensitivity:source=ax,coefficient=1e-3"),
    200,
    ("gz.", "random_telegraph", ":", "=", ",", "nan", "inf", "1e999", "9" * 30, "1_0", '"', "\\", "\x7f", "\n"),
)
def effects(data: bytes) -> None:
    """Check effects in the notation of the command line."""
    try:
        found = parse_effects(_text(data))
    except ConfigError as error:
        check_error_message(error)
        return
    assert found
    for _, effect in found:
        check_finite([getattr(effect, f.name) for f in fields(effect)])


@target("duration", (b"30min", b"1.5 h", b"2d", b"1e3 s"), 40, ("ms", "e", ".", " ", "1e999", "-", "\0"))
def duration(data: bytes) -> None:
    """Check that a duration is positive and finite, or rejected."""
    try:
        seconds = loading.parse_duration_s(_text(data))
    except ConfigError as error:
        check_error_message(error)
        return
    assert 0.0 < seconds < math.inf, seconds


@target("rate", (b"10 Hz", b"0.5Hz", b"every sample"), 40, ("Hz", ".", "0", "1" * 320, "0." + "0" * 30))
def rate(data: bytes) -> None:
    """Check that a rate gives a finite period, or is rejected."""
    try:
        seconds = loading.parse_rate_as_period(_text(data), "every sample")
    except ConfigError as error:
        check_error_message(error)
        return
    assert 0.0 <= seconds < math.inf, seconds


@target(
    "command-line", (b"octave", b"0.1,1,10", b"1,2", b"auto", b"a.rrd", b"1h"), 60, (",", "nan", "inf", "1e999", ".rrd")
)
def command_line(data: bytes) -> None:
    """Check arguments of several parts."""
    text = _text(data)
    for read in (
        options.parse_averaging_times,
        options.parse_arma_order,
        loading.check_viewer_mode,
        lambda word: options.parse_duration("--window", word),
    ):
        try:
            check_finite(read(text))
        except ConfigError as error:
            check_error_message(error)


@target(
    "subscriber-arguments",
    (b"imu/**\0tcp/127.0.0.1:7450", b"*/a/status\0udp/h:1"),
    80,
    ("/**", "$*", "tcp/", "#iface=lo", "?", "[::1]:7450"),
)
def subscriber_arguments(data: bytes) -> None:
    """Check key expression and endpoint of ``watch``, without opening a session."""
    keyexpr, _, endpoint = _text(data).partition("\0")
    try:
        ZenohSubscriber(keyexpr, (endpoint,))
    except ConfigError as error:
        check_error_message(error)
