"""Driver of one device, which reads bytes from a link, decodes samples and assigns a time to each sample.

``Driver.read_and_push_once`` reads from the link once, decodes the bytes, assigns sample times and passes on the
samples. ``Driver.run`` repeats these steps in the thread of the device. If a link cannot be opened, is lost or falls
silent, the driver closes the link and reports an event. The driver then tries to reopen the link after pauses of
increasing length. A fault of one device does not affect other devices.
"""

import json
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf
from typing import Final, Literal

import numpy as np

from drivers.data_types import AXES, NS_PER_S, Chunk, Event, SampleBlock, SenderTimedFormat, make_block
from drivers.decoders.base import Decoder, FilterReportingDecoder, LateFrameCountingDecoder
from drivers.errors import ConfigError, LinkEnded, LinkError, LinkLost
from drivers.links.base import Link, PolledLink
from drivers.timing.sample_clock import SampleClock

READ_TIMEOUT_S: Final = 0.2
"""Longest time in s that one read waits for the first byte."""
MIN_RETRY_PAUSE_S: Final = 0.1
"""Pause before the first attempt to reopen a lost link. The pause doubles with each attempt."""
MAX_RETRY_PAUSE_S: Final = 5.0
"""Longest pause between two attempts to open a link."""
MAX_UNDECODED_BYTES: Final = 2000
"""Number of bytes without a sample after which the status names a probable cause, such as a wrong baud rate."""
IDENTIFICATION_BYTES: Final = 4096
"""Number of undecoded bytes used to identify the format."""
MIN_UNDECODED_S: Final = 3.0
"""Minimum time in s without a decoded sample after which a running device counts as lost.

If ten sample periods are longer, they apply instead.
"""
MAX_QUEUED_EVENTS: Final = 1000
"""Maximum number of events in the queue. If the queue is full, the oldest event is dropped."""
MIN_STALL_S: Final = 0.5
"""Minimum time in s by which a read lasts longer than READ_TIMEOUT_S if the process did not run meanwhile."""
LOSS_REPORT_INTERVAL_S: Final = 1.0
"""Shortest time between two events about lost samples."""

State = Literal["waiting", "running", "lost", "ended"]


@dataclass(frozen=True, slots=True)
class AxisMap:
    """Mapping of sensor axes to output axes, according to the mounting of the sensor.

    Output column i is ``sign[i]`` times column ``source[i]`` of the decoded samples.
    """

    source: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
    sign: tuple[float, ...] = (1.0,) * 6

    def map_axes(self, samples: SampleBlock) -> SampleBlock:
        """Return the samples with the sensor axes mapped to output axes."""
        if self == AxisMap():
            return samples
        values = samples.values[:, self.source] * np.array(self.sign)
        return make_block(samples.t_ns, values, samples.temperature_c, samples.ticks, samples.lost)

    def is_reflection(self, columns: slice) -> bool:
        """Return True if the map of three columns is a reflection, which turning a sensor cannot cause."""
        matrix = np.eye(6)[list(self.source)] * np.array(self.sign)[:, None]
        return bool(np.linalg.det(matrix[columns, columns]) < 0.0)


@dataclass(slots=True)
class SampleCounts:
    """Sample counts of one device since the driver was created."""

    received: int = 0
    bad: int = 0
    lost: int = 0
    late: int = 0  # number of lost samples that the decoder dropped because frames arrived too late


class Driver:
    """Driver that reads the samples of one device.

    Parameters
    ----------
    name
        Name of the device in the configuration.
    link
        Source of the bytes.
    decoder
        Decoder of the wire format.
    clock
        Sample clock, which assigns a time to each sample.
    push
        Function that receives each time-stamped block of samples. The function must not block.
    axes
        Mapping of sensor axes to output axes. None leaves the axes unchanged.
    silence_s
        Time in s without a byte after which the link is reopened; 0 = never.
    keep
        Function that records the received chunks before they are decoded. The function must not block.
    """

    def __init__(
        self,
        name: str,
        link: Link,
        decoder: Decoder,
        clock: SampleClock,
        push: Callable[[SampleBlock], None],
        axes: AxisMap | None = None,
        silence_s: float = 3.0,
        keep: Callable[[Sequence[Chunk]], None] | None = None,
    ) -> None:
        self.name = name
        self.link = link
        self.decoder = decoder
        self.clock = clock
        self.counts = SampleCounts()
        self.state: State = "waiting"
        self.text = f"waiting for {link.name}"
        self.iterations = 0  # number of reads and attempts to open the link; constant while the driver is blocked
        self.times_are_unix = link.epoch == "unix" or isinstance(decoder.timing, SenderTimedFormat)
        self.first_t_ns: int | None = None
        """Time of the first sample; None until a sample arrives."""
        self.unexpected_error: Exception | None = None
        """Exception that shows a bug in the program. The reader of this attribute sets it to None."""
        self._push = push
        self._keep = keep
        self._axes = axes or AxisMap()
        self._silence_s = silence_s
        self._events: deque[Event] = deque(maxlen=MAX_QUEUED_EVENTS)
        self._stop = threading.Event()
        self._undecoded_bytes = self._undecoded_bad = 0
        self._undecoded_since = ""  # local time of day of the first byte without a sample
        self._undecoded_capture = b""  # first bytes of a device whose bytes cannot be decoded
        self._format_hint = ""
        self._polled = link if isinstance(link, PolledLink) else None
        self._counts_late = decoder if isinstance(decoder, LateFrameCountingDecoder) else None
        self._reported_drops = 0  # number of samples that the decoder dropped and that have been reported as missing
        self._last_data_s = 0.0
        self._last_sample_s = 0.0
        self._last_read_s = inf  # end of the last read, on a clock that includes the time in which the host sleeps
        self._newest_t_ns = 0
        self._unreported_samples = 0  # missing samples since the last report
        self._reported_datagrams = 0  # number of dropped datagrams that have been reported
        self._last_report_s = -LOSS_REPORT_INTERVAL_S

    @property
    def late_frames_hint(self) -> str:
        """Message that states the delay of late frames and suggests a remedy; "" if no frame was late recently."""
        return self._counts_late.late_frames_hint if self._counts_late else ""

    @property
    def on_board_filter_note(self) -> str:
        """Note that the samples are corrected by a filter of the sensor; "" if they are not corrected."""
        return self.decoder.on_board_filter_note if isinstance(self.decoder, FilterReportingDecoder) else ""

    def take_events(self) -> list[Event]:
        """Remove and return all queued events, oldest first."""
        return [self._events.popleft() for _ in range(len(self._events))]

    def stop(self) -> None:
        """Stop ``run``, and close the link to interrupt a waiting read."""
        self._stop.set()
        self.link.close()

    def run(self) -> None:
        """Read from the link until the driver is stopped or a replay has ended."""
        while True:
            try:
                return self._run()
            except Exception as error:  # noqa: BLE001 - the status of the device shows the bug
                self.unexpected_error = error
                text = f"the reader failed because of a bug in the program: {error!r}"
            from drivers.links.replay_link import ReplayLink  # slow to import, because it imports all file formats

            if isinstance(self.link, ReplayLink):  # the link would begin again with the first sample
                self.state, self.text = "ended", text
                return None
            self.state, self.text = "lost", f"{text}; trying again"
            if self._stop.wait(MAX_RETRY_PAUSE_S):
                return None

    def _run(self) -> None:
        """Read until the driver is stopped or a replay ends. After a link error, reopen the link."""
        pause_s = MIN_RETRY_PAUSE_S
        if self.state == "lost":  # after an unexpected exception
            self._reset_stream()
        while not self._stop.is_set():
            received = self.counts.received
            self.iterations += 1
            try:
                opening_ns = time.monotonic_ns()
                self.link.open()
                if not self.times_are_unix:
                    self.clock.note_no_unread_data(opening_ns)
                self._last_data_s = time.monotonic()
                self._last_read_s = -inf  # data may have waited in the link before it was opened
                while not self._stop.is_set():
                    self.read_and_push_once()
            except LinkEnded as error:
                self.state, self.text = "ended", str(error)
                self.link.close()
                return
            except LinkError as error:
                if not self._stop.is_set():
                    self._handle_link_error(error)
            if self.counts.received > received:
                pause_s = MIN_RETRY_PAUSE_S
            self._stop.wait(pause_s)
            pause_s = min(2.0 * pause_s, MAX_RETRY_PAUSE_S)
        self.link.close()

    def read_and_push_once(self) -> None:
        """Read from the link once, decode the samples, assign sample times and call ``push``."""
        self.iterations += 1
        asked_ns = time.monotonic_ns()
        chunks = self.link.wait_for_chunks_or_timeout(READ_TIMEOUT_S)
        read_s = _read_suspend_aware_clock_s()
        if read_s - self._last_read_s > READ_TIMEOUT_S + MIN_STALL_S:
            self._handle_stall(chunks)
        self._last_read_s = read_s
        self._report_lost()
        if chunks is None:
            if not self.times_are_unix:
                self.clock.note_no_unread_data(asked_ns)
            self._check_silence()
            return
        self._last_data_s = time.monotonic()
        if self._keep is not None:
            self._keep(chunks)
        if self._polled is not None:
            self.clock.note_dropped_data(self._polled.dropped_datagrams)
        samples = self.decoder.feed(chunks)
        if not samples:
            self._check_undecoded(b"".join(chunk.data for chunk in chunks))
            return
        self._last_sample_s, self._undecoded_bytes = self._last_data_s, 0
        self._undecoded_capture, self._format_hint = b"", ""
        for one in samples:
            # A missing sample was either dropped by the decoder or sent in a message that did not arrive.
            dropped = min(one.lost, self._decoder_drops() - self._reported_drops)
            self._reported_drops += dropped
            for stamped in self.clock.assign_times(one):
                self._count_samples(stamped, dropped)
                self._push(self._axes.map_axes(stamped))
                dropped = 0  # the dropped samples are missing only before the first block
        if self._polled is not None and not self.times_are_unix:
            self.clock.note_end_of_backlog(self._polled.empty_ns)
        self._count_decoder_drops()
        if false_losses := self.clock.take_false_losses():
            self.counts.lost = max(self.counts.lost - false_losses, 0)
            self._unreported_samples = 0
        self._report_lost()
        self._events.extend(self.clock.take_events())
        if self.state != "running":
            self._handle_recovery()

    def _decoder_drops(self) -> int:
        return self.decoder.bad + (self._counts_late.dropped_late_samples if self._counts_late else 0)

    def _count_decoder_drops(self) -> None:
        self.counts.bad = self.decoder.bad
        if self._counts_late:
            self.counts.lost += self._counts_late.dropped_late_samples - self.counts.late
            self.counts.late = self._counts_late.dropped_late_samples

    def _count_samples(self, stamped: SampleBlock, dropped: int) -> None:
        """Count the samples of a block and the lost samples before the block.

        ``dropped`` samples are not counted as lost.
        """
        if self.first_t_ns is None:
            self.first_t_ns = int(stamped.t_ns[0])
        self.counts.received += len(stamped)
        self._newest_t_ns = int(stamped.t_ns[-1])
        if stamped.lost:
            self.counts.lost += max(0, stamped.lost - dropped)
            self._unreported_samples += stamped.lost

    def _report_lost(self) -> None:
        """Report missing samples at most once per second, so that the queue has room for other events."""
        if not self._unreported_samples or time.monotonic() - self._last_report_s < LOSS_REPORT_INTERVAL_S:
            return
        self._event("samples_lost", f"{self._unreported_samples} samples missing{self._describe_dropped()}")
        self._unreported_samples = 0
        self._last_report_s = time.monotonic()

    def _describe_dropped(self) -> str:
        """Return a text that is appended to a message about missing samples if the receive buffer of the link was
        full."""
        total = self._polled.dropped_datagrams if self._polled is not None else 0
        dropped, self._reported_datagrams = total - self._reported_datagrams, total
        return f"; {dropped} datagrams were dropped because the receive buffer was full" if dropped else ""

    def _handle_stall(self, chunks: Sequence[Chunk] | None) -> None:
        """Continue after a time in which the process was stopped, starved or asleep, so that received data have waited.

        A read may time out without having looked at the data. The silence of the device is therefore measured again.
        """
        self._last_data_s = self._last_sample_s = time.monotonic()
        if self.times_are_unix:
            return
        now_ns = time.monotonic_ns()
        # The kernel stamps data that have waited with an earlier time, and the reader stamps them after the stall.
        read_ns = [chunk.t_ns for chunk in (chunks or ())[:1] if now_ns - chunk.t_ns < MIN_STALL_S * NS_PER_S]
        self.clock.note_stall(min(read_ns, default=now_ns))

    def _check_silence(self) -> None:
        silent_s = time.monotonic() - self._last_data_s
        if self._silence_s and silent_s > self._silence_s:
            raise LinkLost(f"{self.link.name} silent for {silent_s:.1f} s")

    def _check_undecoded(self, data: bytes) -> None:
        """Report a device whose bytes cannot be decoded."""
        if not self._undecoded_bytes:
            self._undecoded_bad, self._undecoded_since = self.counts.bad, time.strftime("%H:%M:%S")
        self._count_decoder_drops()
        self._undecoded_bytes += len(data)
        mute_s = self._last_data_s - self._last_sample_s
        patience_s = max(MIN_UNDECODED_S, 10.0 / (self.clock.configured_or_measured_rate_hz or 10.0))
        if self._undecoded_bytes < MAX_UNDECODED_BYTES or (self.state == "running" and mute_s < patience_s):
            return
        why = self.decoder.recent_problem or "wrong baud rate, or another protocol than the configured one"
        self._identify_undecoded(data)
        bad = self.counts.bad - self._undecoded_bad
        rejected = f", {bad} lines or frames rejected since {self._undecoded_since}" if bad else ""
        self.text = (
            f"{self.link.name}: {self._undecoded_bytes} bytes without a sample{rejected}; {why}{self._format_hint}"
        )
        if self.state == "running":
            self._event("link_lost", self.text)
            self.state = "lost"
            self.clock.count_next_gap_by_arrival()

    def _identify_undecoded(self, data: bytes) -> None:
        """After enough bytes without a sample, state once which decoder fits these bytes."""
        missing = IDENTIFICATION_BYTES - len(self._undecoded_capture)
        if self.link.carrier != "bytes" or missing <= 0:
            return
        self._undecoded_capture += data[:missing]
        if len(data) < missing:
            return
        from drivers.wire_format_identification import identify_wire_format

        found = identify_wire_format(self._undecoded_capture)
        if found is None:
            return
        fitting = f'decoder = "{found.decoder}"'
        if type(self.decoder).__module__.endswith(f".{found.decoder}"):  # only its options do not fit
            options = ", ".join(f"{key} = {json.dumps(value)}" for key, value in found.options.items())
            fitting = f"decoder_options = {{ {options} }}" if options else "the default decoder_options"
        self._format_hint = f"; the bytes fit {fitting} (see imu-monitor identify)"

    def _handle_recovery(self) -> None:
        if self.state == "lost":
            self._event("link_back", f"{self.link.name} is back")
        self.state, self.text = "running", ""

    def _handle_link_error(self, error: LinkError) -> None:
        if self.state == "running":
            self._event("link_lost", str(error))
            self.state = "lost"
        self.text = f"{error}; trying again"
        self._reset_stream()

    def _reset_stream(self) -> None:
        """Close the link, and discard the state that depends on the bytes before."""
        self.link.close()
        self.decoder.forget_stream_state()
        self._reported_drops = self._decoder_drops()
        self.clock.count_next_gap_by_arrival()

    def _event(self, kind: str, text: str) -> None:
        # current time on the same clock as the sample times
        t_ns = self._newest_t_ns if self.times_are_unix else time.monotonic_ns()
        self._events.append(Event(kind, t_ns, text))


def _read_suspend_aware_clock_s() -> float:
    """Return a monotonic time in s that, on Linux, also advances while the host sleeps."""
    return time.clock_gettime(time.CLOCK_BOOTTIME) if sys.platform == "linux" else time.monotonic()


def parse_axis_map(table: dict[str, str]) -> AxisMap:
    """Parse the table ``[device.axes]``, for example ``{"gz": "-gy"}``.

    Parameters
    ----------
    table
        Mapping from each output axis to a sensor axis with an optional sign. Absent axes remain unchanged.

    Raises
    ------
    ConfigError
        If an axis is unknown, if gyroscope and accelerometer axes are mixed, or if a sensor axis is used twice.
    """
    source, sign = list(range(6)), [1.0] * 6
    wrong = []
    for axis, word in table.items():
        bare = word.lstrip("+-")
        if axis not in AXES or bare not in AXES or axis[0] != bare[0] or len(word) - len(bare) > 1:
            wrong.append(
                f'{axis} = "{word}": expected two axes of the same kind out of {" ".join(AXES)}, '
                "the second with or without -"
            )
            continue
        source[AXES.index(axis)] = AXES.index(bare)
        sign[AXES.index(axis)] = -1.0 if word.startswith("-") else 1.0
    for column in () if wrong else sorted({column for column in source if source.count(column) > 1}):
        users = [axis for axis, used in zip(AXES, source, strict=True) if used == column]
        stated = " and ".join(
            f'{axis} = "{table[axis]}"' if axis in table else f'{axis} = "{axis}" (default)' for axis in users
        )
        unused = " and ".join(axis for i, axis in enumerate(AXES) if i not in source and axis[0] == AXES[column][0])
        wrong.append(f"{stated} use the same axis of the sensor, and {unused} is lost; use each axis once")
    if wrong:
        raise ConfigError(*wrong)
    return AxisMap(tuple(source), tuple(sign))
