"""Recordings that still contain the wire format of a sensor: CAN logs, captured bytes, and raw data of the daemon.

The file is replayed at full speed through the link ``replay``, a decoder and the sample clock, as in the service. The
clock of the decoder determines the sample times. Captured bytes have no arrival times, so their samples get the times
of the device counter, or even spacing at the stated sample rate.
"""

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

import drivers.decoders
from drivers.data_types import AXES, NO_TICK, CounterTimedFormat, Ints, SampleBlock, Times, Timing, make_block
from drivers.decoders.base import Decoder, FilterReportingDecoder, LateFrameCountingDecoder
from drivers.errors import ConfigError, LinkEnded, LinkUnavailable, RecordingError, describe_error
from drivers.links.replay_link import CARRIERS, ReplayLink, detect_file_kind
from drivers.recordings import Recording, create_recording, load_samples, memory_check, take_last
from drivers.recordings.file_formats.csv_header import is_table_text
from drivers.recordings.file_formats.csv_row_kinds import contains_row_kinds
from drivers.recordings.reading_options import DEFAULT_OPTIONS, ReadingOptions
from drivers.recordings.reading_progress import listen_to_reading_progress
from drivers.recordings.table import TIME_NS, describe_no_recording
from drivers.timing.arrival_timeline import split_by_arrival_time
from drivers.timing.sample_clock import SampleClock
from drivers.validation import module_lookup
from drivers.validation.settings_model import TableError
from monitor.commands.progress_callback import ProgressCallback, ignore_progress
from monitor.common.unit_formatting import format_count
from monitor.settings.driver_settings import build_link_and_decoder, list_decoders

LINK_KEYS: Final = ("bytes_per_second", "channel")
"""Keys of the link ``replay`` that can be set in addition to the keys of the decoder."""
CONTENTS: Final = {"log": "CAN frames", "capture": "captured bytes", "raw": "raw data"}
"""Description of each kind of file that needs a decoder."""
READ_TIMEOUT_S: Final = 1.0
MIN_STEP_BACK_S: Final = 60.0
"""Minimum duration in s of half the range of a counter for the detection of steps back.

If half the range lasts at least this long, a step of more than half the range is a step back. Otherwise, the step is a
gap.
"""


@dataclass(frozen=True, slots=True)
class DecoderChoice:
    """Decoder of a file that contains the wire format of a sensor."""

    name: str
    options: Mapping[str, Any] = field(default_factory=dict)  # keys of the decoder, and those in LINK_KEYS


@dataclass(frozen=True, slots=True)
class LoadingOptions:
    """Options for reading or decoding a recording."""

    rate_hz: float | None = None  # sample rate of a recording that has neither times nor a rate
    last_s: float | None = None  # duration at the end of the recording to use; None = all
    reading: ReadingOptions = DEFAULT_OPTIONS  # topic, columns and units to read
    decoder: DecoderChoice | None = None  # decoder of a CAN log, of captured bytes, or of raw data of the daemon


DEFAULT_LOADING: Final = LoadingOptions()


def load_recording(
    path: Path, options: LoadingOptions = DEFAULT_LOADING, report_progress: ProgressCallback = ignore_progress
) -> Recording:
    """Read a recording, and decode it if it contains the wire format of a sensor.

    Parameters
    ----------
    path : Path
        File, or folder of segments.
    options : LoadingOptions, optional
        Options for reading and decoding.
    report_progress : callable, optional
        Function that receives the progress.

    Raises
    ------
    RecordingError
        If the file contains no sample.
    ConfigError
        If the decoder is missing or does not fit, an option is wrong, or the samples do not fit into memory.
    """
    kind, decoder = None, options.decoder
    with contextlib.suppress(ConfigError, OSError):  # load_samples describes an unknown or missing file
        kind = detect_file_kind(path) if path.exists() else None
    if decoder is None:
        if kind in CONTENTS and not (kind in CARRIERS and _is_table(path)):
            names = list_decoders(CARRIERS[kind]) if kind in CARRIERS else module_lookup.list_modules(drivers.decoders)
            if kind == "capture" and (other := describe_no_recording(path)):
                raise RecordingError(f"{path}: contains no samples{other}")
            raise ConfigError(f"{path}: contains {CONTENTS[kind]}; name the decoder with --decoder: {', '.join(names)}")
        report_progress("reading", None)
        with listen_to_reading_progress(lambda share: report_progress("reading", share)):
            return load_samples(path, options.rate_hz, options.last_s, options.reading)
    if kind == "recording":
        raise ConfigError(f"{path}: contains samples, which need no decoder; leave out --decoder")
    if options.reading.topic is not None:
        raise ConfigError(f"{path}: contains no topics; leave out --topic")
    report_progress("decoding", None)
    with listen_to_reading_progress(lambda share: report_progress("decoding", share)):
        found = _decode_file(path, decoder, options.rate_hz)
    return found if options.last_s is None else take_last(found, options.last_s)


def _is_table(path: Path) -> bool:
    """Return True if a file with the suffix of a capture or of a CAN log contains a table."""
    try:
        return is_table_text(path) or contains_row_kinds(path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {describe_error(error)}") from error


def _decode_file(path: Path, choice: DecoderChoice, rate_hz: float | None) -> Recording:
    link, decoder = _build(path, choice)
    clock = SampleClock(decoder.timing, rate_hz)
    untimed = link.epoch == "monotonic" and "bytes_per_second" not in choice.options
    capture_times = _CaptureTimes(path, decoder.timing, rate_hz) if untimed else None
    limit = memory_check.RecordingSizeLimits(path, _size_bytes(path), memory_check.available_bytes())
    blocks: list[SampleBlock] = []
    received_bytes = rows = 0
    start_ns: int | None = None
    try:
        link.open()
        while True:
            chunks = link.wait_for_chunks_or_timeout(READ_TIMEOUT_S) or ()
            received_bytes += sum(len(chunk.data) for chunk in chunks)
            for samples in decoder.feed(chunks) if chunks else ():
                timed = samples if capture_times is None else capture_times.assign_device_times(samples)
                start_ns = int(timed.t_ns[0]) if start_ns is None else start_ns
                for batch in split_by_arrival_time(timed, start_ns):
                    blocks += clock.assign_times(batch)
                rows += len(timed)
            limit.check_row_count(rows)
    except LinkEnded:
        pass  # the expected end of the file; its text repeats link.notes, which are part of the result
    except LinkUnavailable as error:
        raise RecordingError(str(error)) from error
    finally:
        link.close()
    if not blocks:
        why = decoder.recent_problem or "the decoder or its options do not fit"
        content = f"{received_bytes} bytes contain no sample; {why}" if received_bytes else "the file contains no data"
        raise RecordingError(" ".join((f"{path}: {content}.", *link.notes)).rstrip("."))
    clock.compare_rates_at_end()
    columns: dict[str, Times] = {TIME_NS: np.concatenate([one.t_ns for one in blocks])}
    values = np.concatenate([one.values for one in blocks])
    columns |= {axis: values[:, i] for i, axis in enumerate(AXES) if not np.isnan(values[:, i]).all()}
    columns["temperature"] = np.concatenate([one.temperature_c for one in blocks])
    stated_hz = None if rate_hz is None else clock.configured_or_measured_rate_hz
    notes = (*link.notes, *_describe_rejected_data(decoder, clock))
    return replace(create_recording(columns, stated_hz, str(path)), notes=notes)


def _build(path: Path, choice: DecoderChoice) -> tuple[ReplayLink, Decoder]:
    """Build the link and the decoder. Raise ConfigError with one line that names the options of the command."""
    link_keys = {key: value for key, value in choice.options.items() if key in LINK_KEYS}
    options = {key: value for key, value in choice.options.items() if key not in LINK_KEYS}
    table = {"link": "replay", "path": str(path.absolute()), "speed": "max", "decoder": choice.name, **link_keys}
    try:
        built = build_link_and_decoder({**table, "decoder_options": options}, Path.cwd())
    except TableError as error:
        lines = [_name_option(*problem) for problem in error.problems if problem.key_path != "path"]
        where = [problem.text for problem in error.problems if problem.key_path == "path"]  # begins with the path
        raise ConfigError("; ".join(where) or f"{path}: {'; '.join(lines)}") from error
    assert isinstance(built.link, ReplayLink)
    return built.link, built.decoder


def _name_option(key_path: str, text: str) -> str:
    if not key_path:
        return text
    key = key_path.removeprefix("decoder_options").removeprefix(".")
    return f"--decoder: {text}" if key_path == "decoder" else f"--option {key}: {text}"


def _size_bytes(path: Path) -> int:
    files = path.iterdir() if path.is_dir() else [path]
    return sum(one.stat().st_size for one in files if one.is_file())


def _describe_rejected_data(decoder: Decoder, clock: SampleClock) -> Iterator[str]:
    """Yield notes about rejected frames and repeated samples, and about the clock."""
    if decoder.bad:
        why = f": {decoder.recent_problem}" if decoder.recent_problem else ""
        yield f"{format_count(decoder.bad, 'frame')} rejected{why}."
    if isinstance(decoder, LateFrameCountingDecoder) and decoder.dropped_late_samples:
        hint = f": {decoder.late_frames_hint}" if decoder.late_frames_hint else ""
        yield f"{format_count(decoder.dropped_late_samples, 'sample')} left out because of late frames{hint}."
    if isinstance(decoder, FilterReportingDecoder) and (note := decoder.on_board_filter_note):
        yield f"{note[0].upper()}{note[1:]}."
    if clock.dropped_repeated_rows:
        yield f"{format_count(clock.dropped_repeated_rows, 'repeated sample')} left out."
    jumps = [event.text for event in clock.take_events(ended=True) if event.kind == "clock_jumped"]
    if jumps:
        more = f" ({len(jumps) - 1} more such events)" if len(jumps) > 1 else ""
        yield f"{jumps[0][0].upper()}{jumps[0][1:]}{more}."
    if (measured_hz := clock.contradicting_rate_hz) is not None:
        yield f"The measured rate of {measured_hz:.6g} Hz differs from the stated rate."


class _CaptureTimes:
    """Times of samples from captured bytes, which have no arrival times. The first time is 0.

    Parameters
    ----------
    path : Path
        File, named in error messages.
    timing : Timing
        Timing of the wire format.
    rate_hz : float or None
        Stated sample rate in Hz. It is needed unless the format has a counter that measures time.
    """

    def __init__(self, path: Path, timing: Timing, rate_hz: float | None) -> None:
        self._path = path
        self._counter = timing if isinstance(timing, CounterTimedFormat) else None
        self._period_s = None if rate_hz is None else 1.0 / rate_hz
        self._tick: int | None = None  # last counter value
        self._typical_step = 1  # typical step of the counter
        self._elapsed_s = 0.0  # time of the newest sample
        self._started = False  # True after the first sample

    def assign_device_times(self, samples: SampleBlock) -> SampleBlock:
        """Return the samples with times from the device counter, or with evenly spaced times.

        Raises
        ------
        ConfigError
            If the samples contain no device time and the sample rate is unknown.
        """
        counted = self._counter is not None and bool((samples.ticks != NO_TICK).all())
        period_s = self._counter.tick_s if counted and self._counter and self._counter.tick_s else self._period_s
        if period_s is None:
            raise ConfigError(f"{self._path}: contains no times; give the sample rate with --rate HZ")
        steps = (
            self._counter_steps(samples.ticks, self._counter.modulus, period_s) if counted and self._counter else None
        )
        if steps is None:
            self._tick = None
            steps = np.ones(len(samples), np.int64)
            steps[0] += samples.lost
        if not self._started:
            steps[0] = 0
            self._started = True
        elapsed_s = self._elapsed_s + np.cumsum(steps) * period_s
        self._elapsed_s = float(elapsed_s[-1])
        t_ns = np.rint(elapsed_s * 1e9).astype(np.int64)
        return make_block(t_ns, samples.values, samples.temperature_c, samples.ticks, samples.lost)

    def _counter_steps(self, ticks: Ints, modulus: int, period_s: float) -> Ints:
        """Return the step of the counter before each sample [n]. A step back is replaced with the typical step."""
        before = self._tick
        steps: Ints = np.diff(ticks, prepend=ticks[0] if before is None else before) % modulus
        self._tick = int(ticks[-1])
        forward = (2 * steps < modulus) | (0.5 * modulus * period_s < MIN_STEP_BACK_S)
        usual = steps[forward & (steps > 0)]
        if usual.size:
            self._typical_step = int(np.median(usual))
        steps = np.where(forward, steps, self._typical_step)
        if before is None:  # earlier samples had no counter value
            steps[0] = self._typical_step
        return steps
