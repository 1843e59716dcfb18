"""One device's reader: bytes from its link to samples with times, for ever.

``Driver.step`` is the corridor: read, feed, stamp, push; it decides nothing. ``Driver.run`` keeps it going in a
thread of its own: a link that cannot be opened, is lost or falls silent is closed, reported, and opened again with
growing pauses until the driver is stopped or a replay has ended. Nothing that happens to one device reaches another.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from drivers.decoders.base import CountingLate, Decoder
from drivers.errors import ConfigError, LinkEnded, LinkError, LinkLost
from drivers.links.base import Link
from drivers.sample import AXES, Chunk, Event, Given, SampleBlock, block
from drivers.timing.sample_clock import SampleClock

READ_TIMEOUT_S: Final = 0.2
FIRST_PAUSE_S: Final = 0.1
LONGEST_PAUSE_S: Final = 5.0
UNDECODED_BYTES: Final = 2000
"""So many bytes without one sample: probably the wrong baud rate or decoder, and said so."""
MUTE_S: Final = 3.0
"""A running device whose bytes hold no sample for so long, and for ten sample periods, is lost."""
EVENTS_KEPT: Final = 1000
TELL_EVERY_S: Final = 1.0

State = Literal["waiting", "running", "lost", "ended"]


@dataclass(frozen=True, slots=True)
class AxisMap:
    """Which measured axis goes where: column i of the output is sign[i] · column source[i] of the decoder's."""

    source: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
    sign: tuple[float, ...] = (1.0,) * 6

    def apply(self, samples: SampleBlock) -> SampleBlock:
        """The samples on the axes of the configuration."""
        if self == AxisMap():
            return samples
        values = samples.values[:, self.source] * np.array(self.sign)
        return block(samples.t_ns, values, samples.temperature_c, samples.ticks, samples.lost)


@dataclass(slots=True)
class Counts:
    """Samples of one device since its start; received + bad + lost = sent."""

    received: int = 0
    bad: int = 0
    lost: int = 0
    late: int = 0  # of the lost: left out by the decoder because some of their frames came too late


class Driver:
    """Reads one device.

    Args:
        name: the device's name in the configuration
        link, decoder, clock: what it is read with
        axes: the mounting
        push: takes each stamped block; must not block
        silence_s: the link is opened anew after so long without a byte; 0 = never
        keep: takes the bytes as they came, too; must not block
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
        self.counts = Counts()
        self.state: State = "waiting"
        self.text = f"waiting for {link.name}"
        self.turns = 0  # how often it has read, with or without bytes, or tried to open: stands still when it is stuck
        self.times_are_unix = link.epoch == "unix" or isinstance(decoder.timing, Given)
        self.first_t_ns: int | None = None
        """Time of the first sample since the start; None until it has come."""
        self._push = push
        self._keep = keep
        self._axes = axes or AxisMap()
        self._silence_s = silence_s
        self._events: deque[Event] = deque(maxlen=EVENTS_KEPT)
        self._stop = threading.Event()
        self._undecoded = 0
        self._counts_late = decoder if isinstance(decoder, CountingLate) else None
        self._placed = 0  # samples left out by the decoder whose places have been told as lost
        self._heard_s = 0.0
        self._sampled_s = 0.0
        self._newest_t_ns = 0
        self._untold = self._holes = 0  # samples missing, and in how many places, since that was told
        self._told_s = -TELL_EVERY_S

    @property
    def late_hint(self) -> str:
        """By how much frames of one sample come too late and what to do; "" if none has for a while."""
        return self._counts_late.late_hint if self._counts_late else ""

    def take_events(self) -> list[Event]:
        """Events since the last call, oldest first."""
        return [self._events.popleft() for _ in range(len(self._events))]

    def stop(self) -> None:
        """Ask ``run`` to end; a waiting read is ended too."""
        self._stop.set()
        self.link.close()

    def run(self) -> None:
        """Read until stopped; to be called in the device's own thread."""
        try:
            self._run()
        except Exception as error:
            # a bug: the thread dies loudly, and the status does not go on saying that all is well
            self.state, self.text = "lost", f"reading ended by a fault of the program: {error!r}"
            raise

    def _run(self) -> None:
        pause_s = FIRST_PAUSE_S
        while not self._stop.is_set():
            received = self.counts.received
            self.turns += 1
            try:
                opening_ns = time.monotonic_ns()
                self.link.open()
                if not self.times_are_unix:
                    self.clock.link_idle(opening_ns)
                self._heard_s = time.monotonic()
                while not self._stop.is_set():
                    self.step()
            except LinkEnded as error:
                self.state, self.text = "ended", str(error)
                self.link.close()
                return
            except LinkError as error:
                if not self._stop.is_set():
                    self._gone(error)
            if self.counts.received > received:
                pause_s = FIRST_PAUSE_S
            self._stop.wait(pause_s)
            pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)
        self.link.close()

    def step(self) -> None:
        """One read and all that follows from it."""
        self.turns += 1
        asked_ns = time.monotonic_ns()
        chunks = self.link.read(READ_TIMEOUT_S)
        self._tell_lost()
        if chunks is None:
            if not self.times_are_unix:
                self.clock.link_idle(asked_ns)
            self._watch_silence()
            return
        self._heard_s = time.monotonic()
        if self._keep is not None:
            self._keep(chunks)
        samples = self.decoder.feed(chunks)
        if not samples:
            self._watch_undecoded(sum(len(chunk.data) for chunk in chunks))
            return
        self._sampled_s, self._undecoded = self._heard_s, 0
        for one in samples:
            # a decoder's hole is of samples it left out, or of messages that a sender counted and nobody received
            left_out = min(one.lost, self._left_out() - self._placed)
            self._placed += left_out
            for stamped in self.clock.stamp(one):
                self._count(stamped, left_out)
                self._push(self._axes.apply(stamped))
                left_out = 0  # they stood before the first row
        self._count_left_out()
        self._tell_lost()
        self._events.extend(self.clock.take_events())
        if self.state != "running":
            self._back()

    def _left_out(self) -> int:
        """Samples that the decoder has left out, bad or late."""
        return self.decoder.bad + (self._counts_late.late if self._counts_late else 0)

    def _count_left_out(self) -> None:
        self.counts.bad = self.decoder.bad
        if self._counts_late:
            self.counts.lost += self._counts_late.late - self.counts.late
            self.counts.late = self._counts_late.late

    def _count(self, stamped: SampleBlock, left_out: int) -> None:
        if self.first_t_ns is None:
            self.first_t_ns = int(stamped.t_ns[0])
        self.counts.received += len(stamped)
        self._newest_t_ns = int(stamped.t_ns[-1])
        if stamped.lost:
            self.counts.lost += max(0, stamped.lost - left_out)
            self._untold += stamped.lost
            self._holes += 1

    def _tell_lost(self) -> None:
        """One event a second at most: a bad line must not drown all else."""
        if not self._untold or time.monotonic() - self._told_s < TELL_EVERY_S:
            return
        places = "" if self._holes == 1 else f" in {self._holes} places"
        self._event("samples_lost", f"{self._untold} samples missing{places}")
        self._untold = self._holes = 0
        self._told_s = time.monotonic()

    def _watch_silence(self) -> None:
        silent_s = time.monotonic() - self._heard_s
        if self._silence_s and silent_s > self._silence_s:
            raise LinkLost(f"{self.link.name} silent for {silent_s:.1f} s")

    def _watch_undecoded(self, size: int) -> None:
        self._count_left_out()
        self._undecoded += size
        mute_s = self._heard_s - self._sampled_s
        patience_s = max(MUTE_S, 10.0 / (self.clock.rate_hz or 10.0))
        if self._undecoded < UNDECODED_BYTES or (self.state == "running" and mute_s < patience_s):
            return
        why = self.decoder.hint or "wrong baud rate, or another protocol than the configured one"
        self.text = f"{self.link.name}: {self._undecoded} bytes and no sample in them; {why}"
        if self.state == "running":
            self._event("link_lost", self.text)
            self.state = "lost"
            self.clock.pause()

    def _back(self) -> None:
        if self.state == "lost":
            self._event("link_back", f"{self.link.name} is back")
        self.state, self.text = "running", ""

    def _gone(self, error: LinkError) -> None:
        if self.state == "running":
            self._event("link_lost", str(error))
            self.state = "lost"
        self.text = f"{error}; trying again"
        self.link.close()
        self.decoder.reset()
        self._placed = self._left_out()
        self.clock.pause()

    def _event(self, kind: str, text: str) -> None:
        # the host's clock at the moment, in the epoch of the samples
        t_ns = self._newest_t_ns if self.times_are_unix else time.monotonic_ns()
        self._events.append(Event(kind, t_ns, text))


def axis_map(table: dict[str, str]) -> AxisMap:
    """The map of ``[device.axes]``, e.g. ``{"gz": "-gy"}``: output axis <- signed measured axis.

    Raises:
        ConfigError: an axis that is none of AXES, or of the other kind
    """
    source, sign = list(range(6)), [1.0] * 6
    wrong = []
    for axis, word in table.items():
        bare = word.lstrip("+-")
        if axis not in AXES or bare not in AXES or axis[0] != bare[0] or len(word) - len(bare) > 1:
            wrong.append(
                f'{axis} = "{word}"; both are one of {" ".join(AXES)} and of one kind, the right one with or without -'
            )
            continue
        source[AXES.index(axis)] = AXES.index(bare)
        sign[AXES.index(axis)] = -1.0 if word.startswith("-") else 1.0
    if wrong:
        raise ConfigError(*wrong)
    return AxisMap(tuple(source), tuple(sign))
