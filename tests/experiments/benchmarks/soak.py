"""Run a simulated month through the whole service as fast as possible: decoder, clock, window, outputs and storage.

    python -m tests.experiments.benchmarks.soak --days 30 --rate 50 --plot docs/pictures/soak.png

The frames of the sensor are encoded and decoded. One frame in 20 000 is lost, one in 20 000 has a flipped bit, and
random bytes follow one in 50 000. Memory, descriptors, threads and the size of the storage are recorded every second.
At the end, sent = received + lost + flipped must hold exactly, and the recording must contain all received samples.
"""

import argparse
import dataclasses
import os
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal

import numpy as np
import psutil

from drivers.data_types import Chunk, make_block
from drivers.decoders.binary_frames import vectornav_binary
from drivers.driver import SampleCounts
from drivers.errors import LinkEnded, LinkLost
from drivers.links.base import Carrier
from drivers.recordings import segment_file
from monitor.common import shipped_config_paths
from monitor.daemon.service import Service
from monitor.history.sqlite_store import open_history
from monitor.history.time_ranges import TimeRange
from monitor.noise.model_loading import read_model
from monitor.settings import loading

ROWS: Final = 8192
START_NS: Final = 1_760_000_000_000_000_000
LOST: Final = 1 / 20_000
FLIPPED: Final = 1 / 20_000
RUBBISH: Final = 1 / 50_000
CONFIG = """
[[device]]
name = "soak"
rate = {rate}
[device.driver]
link = "virtual"
decoder = "vectornav_binary"
[zenoh]
listen = ["tcp/127.0.0.1:0"]
[viewer]
mode = "none"
[storage]
folder = "{folder}"
keep = "{keep}"
"""


@dataclass
class Truth:
    """Numbers of sent, lost and damaged frames."""

    sent: int = 0
    lost: int = 0
    flipped: int = 0
    rubbish: int = 0


class SimulatedLink:
    """Link that delivers the frames of a simulated sensor as fast as they are read."""

    carrier: Carrier = "bytes"
    epoch: Literal["monotonic", "unix"] = "unix"
    name = "a simulated link"

    def __init__(self, rate_hz: float, samples: int) -> None:
        self.truth = Truth()
        self._rate_hz = rate_hz
        self._samples = samples
        self._encoder = vectornav_binary.build(vectornav_binary.Settings())
        self._stream = read_model(shipped_config_paths.CONFIG_FOLDER / "models" / "consumer-mems.toml").start_stream(
            rate_hz, 1
        )
        self._rng = np.random.default_rng(1)
        self._closed = threading.Event()

    def open(self) -> None:
        self._closed.clear()

    def close(self) -> None:
        self._closed.set()

    def wait_for_chunks_or_timeout(self, timeout_s: float) -> list[Chunk] | None:
        if self._closed.is_set():
            raise LinkLost("closed")
        truth = self.truth
        n = min(ROWS, self._samples - truth.sent)
        if n == 0:
            raise LinkEnded("the end of the month")
        index = np.arange(truth.sent, truth.sent + n)
        drawn = self._stream.draw_samples_with_temperature(n)
        t_ns = START_NS + np.rint(index * (1e9 / self._rate_hz)).astype(np.int64)
        ticks = np.rint(index * (1e9 / self._rate_hz)).astype(np.int64)
        samples = make_block(
            t_ns, drawn.values, 24.0 + 6.0 * np.sin(index * (2 * np.pi / 86400 / self._rate_hz)), ticks
        )
        frames = [chunk.data for chunk in self._encoder.encode(samples)]
        return [Chunk(self._damage(frames, n), int(t_ns[-1]))]

    def _damage(self, frames: list[bytes], n: int) -> bytes:
        """Return the frames with random faults, except in the first and last frame, so that all can be counted."""
        draws = self._rng.random(n)
        draws[[0, -1]] = 1.0
        for at in np.flatnonzero(draws < LOST):
            frames[at] = b""
            self.truth.lost += 1
        for at in np.flatnonzero((draws >= LOST) & (draws < LOST + FLIPPED)):
            damaged = bytearray(frames[at])
            damaged[12] ^= 0x10
            frames[at] = bytes(damaged)
            self.truth.flipped += 1
        for at in np.flatnonzero((draws >= LOST + FLIPPED) & (draws < LOST + FLIPPED + RUBBISH)):
            frames[at] += self._rng.bytes(40).replace(b"\xfa", b"\x00")
            self.truth.rubbish += 1
        self.truth.sent += n
        return b"".join(frames)


@dataclass
class ResourceHistory:
    """Resources of the process, recorded once per second."""

    days: list[float] = field(default_factory=list)
    rows: list[tuple[float, ...]] = field(default_factory=list)  # MB, descriptors, threads, MB of the store


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--days", type=float, default=30.0)
    parser.add_argument("--rate", type=float, default=50.0)
    parser.add_argument("--keep", default="30d", help="of the recording")
    parser.add_argument("--plot", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "soak.toml"
        path.write_text(CONFIG.format(rate=arguments.rate, folder=Path(folder) / "store", keep=arguments.keep))
        link = SimulatedLink(arguments.rate, round(arguments.days * 86400 * arguments.rate))
        config = loading.load_config(path)
        (one,) = config.devices
        device = one.model_copy(update={"driver": dataclasses.replace(one.driver, link=link)})
        service = Service(dataclasses.replace(config, devices=(device,)))
        history, begun = ResourceHistory(), time.monotonic()
        done = threading.Event()
        watcher = threading.Thread(target=_watch, args=(service, arguments.rate, Path(folder) / "store", history, done))
        watcher.start()
        service.run()
        done.set()
        watcher.join()
        took_s = time.monotonic() - begun
        _print_results(service, link, history, took_s, Path(folder) / "store")
        if arguments.plot is not None:
            _draw(history, arguments.plot)


def _watch(service: Service, rate_hz: float, store: Path, history: ResourceHistory, done: threading.Event) -> None:
    process = psutil.Process()
    while not done.wait(1.0):
        history.days.append(service.workers[0].driver.counts.received / rate_hz / 86400)
        history.rows.append(
            (process.memory_info().rss / 1e6, process.num_fds(), process.num_threads(), _size(store) / 1e6)
        )


def _size(folder: Path) -> int:
    total = 0
    for path in folder.rglob("*"):
        try:
            total += os.lstat(path).st_size
        except FileNotFoundError:  # packed or deleted meanwhile
            continue
    return total


def _print_results(service: Service, link: SimulatedLink, history: ResourceHistory, took_s: float, store: Path) -> None:
    counts, truth = service.workers[0].driver.counts, link.truth
    print(f"{truth.sent} samples in {took_s:.0f} s, {truth.sent / took_s:.0f} a second")
    print(f"received {counts.received}, lost {counts.lost}, bad {counts.bad}; lost on the way {truth.lost},", end=" ")
    print(f"flipped {truth.flipped}, rubbish {truth.rubbish}: {_count_samples(counts, truth)} of {truth.sent} sent")
    assert _count_samples(counts, truth) == truth.sent
    recorded = missing = 0
    for path in segment_file.list_segments(store / "soak"):
        for piece in segment_file.read_samples(path):
            recorded += len(piece.samples)
            missing += piece.samples.lost
    print(f"recorded {recorded}, missing in the recording {missing}: sum {recorded + missing}")
    with open_history(store / "history.sqlite") as reader:
        kept = list(reader.read_rows("soak", TimeRange(-np.inf, np.inf)))
        _, events = reader.read_events("soak", TimeRange(-np.inf, np.inf), 1)
    print(f"history: {len(kept)} rows of {', '.join(sorted({f'{row.width_s} s' for row in kept}))}, {events} events")
    sums = [sum(row.counts[at] for row in kept) for at in range(3)]
    print(f"received, lost and bad of all its rows: {sums}")
    assert sums == [counts.received, counts.lost, counts.bad]
    assert recorded == counts.received
    early, late = _max_in_part(history, 0.1, 0.5), _max_in_part(history, 0.5, 1.0)
    names = ("memory MB", "descriptors", "threads", "store MB")
    for at, name in enumerate(names):
        print(f"{name}: most before the half {early[at]:.1f}, after it {late[at]:.1f}")
    estimator = service.workers[0].pipeline.estimator
    print(f"the window holds {estimator.samples_in_window if estimator is not None else 0} samples")


def _count_samples(counts: SampleCounts, truth: Truth) -> int:
    """Return the number of counted samples. Random bytes may also count as a bad frame."""
    assert truth.flipped <= counts.bad <= truth.flipped + truth.rubbish
    return counts.received + counts.lost + truth.flipped


def _max_in_part(history: ResourceHistory, begin: float, end: float) -> tuple[float, ...]:
    rows = history.rows[int(begin * len(history.rows)) : int(end * len(history.rows))]
    return tuple(np.max(np.array(rows or [(np.nan,) * 4]), axis=0).tolist())


def _draw(history: ResourceHistory, path: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(4, 1, sharex=True, figsize=(9, 8), constrained_layout=True)
    titles = ("resident memory, MB", "open descriptors", "threads", "store on disk, MB")
    for at, (axis, title) in enumerate(zip(axes, titles, strict=True)):
        axis.plot(history.days, [row[at] for row in history.rows], color="#2a6f97", linewidth=1.2)
        axis.set_ylim(bottom=0)
        axis.set_ylabel(title)
        axis.grid(alpha=0.3)
    axes[-1].set_xlabel("simulated days")
    axes[0].set_title("A simulated month through the whole service")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
