"""Tests of rejected frames beside samples and in place of samples, through link, decoder, clock and counts.

The arrival times are simulated, so that no result depends on the speed of the machine.
"""

from collections.abc import Callable

import numpy as np
import pytest

from drivers.data_types import NO_TICK, Chunk, CounterTimedFormat, make_block
from drivers.decoders import dbc
from drivers.decoders.base import Decoder
from drivers.decoders.binary_frames import bno08x_rvc, stim300, vectornav_binary
from drivers.decoders.messages import ros2_imu, samples
from drivers.decoders.text_lines import text
from drivers.driver import Driver
from drivers.timing.rejected_frames import RejectedFrameTest
from drivers.timing.sample_clock import SampleClock
from tests.support.loopback_link import LoopbackLink
from tests.support.settings import read_settings

RATE_HZ = 100.0
START_NS = 10**14
COLUMNS = ["gx", "gy", "gz", "ax", "ay", "az"]
J1939 = {"file": "j1939_imu", "signals": {"gz": "AngularRateInformation.YawRate"}}


def build_text(**options: object) -> Decoder:
    return text.build(read_settings(text.Settings, {"columns": COLUMNS, "first_line": "keep"} | options))


DECODERS: dict[str, Callable[[], Decoder]] = {
    "text": build_text,
    "nmea": lambda: build_text(nmea=True),
    "text with a counter": lambda: build_text(columns=["counter", *COLUMNS], counter_modulus=65536),
    "bno08x_rvc": lambda: bno08x_rvc.build(bno08x_rvc.Settings()),
    "stim300": lambda: stim300.build(stim300.Settings()),
    "vectornav_binary": lambda: vectornav_binary.build(vectornav_binary.Settings()),
    "dbc": lambda: dbc.build(read_settings(dbc.Settings, J1939)),
    "ros2_imu": lambda: ros2_imu.build(ros2_imu.Settings()),
    "ros2_imu without sequence numbers": lambda: ros2_imu.build(ros2_imu.Settings()),
    "samples": lambda: samples.build(samples.Settings()),
}


def make_garbage(name: str, good: list[Chunk], rng: np.random.Generator) -> list[Chunk]:
    """Return chunks that the decoder rejects, for each kind of damage."""
    if "text" in name or name == "nmea":
        return [Chunk(data, 0) for data in (b"hello, world\r\n", b"1,2,3\n", b"$1,2,3,4,5,6*00\n", b"x,y,z,4,5,6\n")]
    if name == "dbc":
        return [Chunk(b"\1\2", 0, good[0].address), Chunk(b"", 0, good[0].address)]
    damaged = [chunk.data[:-1] + bytes([chunk.data[-1] ^ 0x55]) for chunk in good[:3]]
    if name in ("samples", "ros2_imu", "ros2_imu without sequence numbers"):
        damaged = [chunk.data[:20] for chunk in good[:3]]
    return [Chunk(data, 0) for data in (*damaged, rng.bytes(40))]


def send_samples(decoder: Decoder, n: int) -> list[Chunk]:
    """Return one chunk for each of ``n`` samples at RATE_HZ."""
    index = np.arange(n)
    ticks = np.full(n, NO_TICK, np.int64)
    if isinstance(decoder.timing, CounterTimedFormat):
        tick_s = decoder.timing.tick_s or 1.0 / RATE_HZ
        ticks = np.rint(index / RATE_HZ / tick_s).astype(np.int64) % decoder.timing.modulus
    values = 0.01 + 1e-4 * (index[:, None] % 1000) + np.arange(6)
    rows = make_block(np.rint(START_NS + index / RATE_HZ * 1e9).astype(np.int64), values, None, ticks)
    return [chunk for i in range(n) for chunk in decoder.encode(rows[i : i + 1])]


def receive(
    name: str, configured_hz: float | None, reads: list[list[Chunk]], decoder: Decoder
) -> tuple[Driver, np.ndarray]:
    """Return the driver that has received the chunks of each read, and the times [n] of all rows in ns."""
    link, rows = LoopbackLink(), []
    driver = Driver(name, link, decoder, SampleClock(decoder.timing, configured_hz), rows.append, silence_s=0.0)
    link.open()
    for chunks in reads:
        for chunk in chunks:
            link.write(chunk)
        driver.read_and_push_once()
    return driver, np.concatenate([row.t_ns for row in rows])


@pytest.mark.parametrize("garbage_per_sample", [1, 20])
@pytest.mark.parametrize("configured", [True, False])
@pytest.mark.parametrize("name", DECODERS)
def test_garbage_beside_samples_is_bad_and_changes_nothing_else(
    name: str, configured: bool, garbage_per_sample: int
) -> None:
    """Garbage arrives at random times beside 6 s of samples, and a read contains about 30 ms of both."""
    rng = np.random.default_rng(5)
    n = 600
    good = send_samples(DECODERS[name](), n)
    sent_ns = START_NS + np.rint(np.arange(len(good)) * (n / len(good)) / RATE_HZ * 1e9)
    kinds = make_garbage(name, good, rng)
    count = n * garbage_per_sample
    garbage = [kinds[i] for i in rng.integers(0, len(kinds), count)]
    at_ns = np.sort(rng.uniform(START_NS, sent_ns[-1], count))
    order = np.argsort(np.concatenate([sent_ns, at_ns]), kind="stable")
    times, both = np.concatenate([sent_ns, at_ns])[order], [*good, *garbage]
    arrived_ns = np.ceil(times / 3e7) * 3e7
    attached = name != "ros2_imu without sequence numbers"
    reads: dict[int, list[Chunk]] = {}
    for i, t_ns in zip(order.tolist(), arrived_ns.astype(np.int64).tolist(), strict=True):
        chunk = both[i]
        reads.setdefault(t_ns, []).append(Chunk(chunk.data, t_ns, chunk.address, chunk.attachment if attached else b""))
    decoder = DECODERS[name]()
    driver, t_ns = receive(name, RATE_HZ if configured else None, [*reads.values()], decoder)
    driver.clock.compare_rates_at_end()
    assert driver.counts.received >= n - 1  # the last frame may not be complete
    assert driver.counts.lost == 0
    assert driver.counts.bad > 0
    assert driver.clock.measured_hz == pytest.approx(RATE_HZ, rel=0.005)
    assert driver.clock.contradicting_rate_hz is None
    assert np.diff(t_ns[300:]) == pytest.approx(1e9 / RATE_HZ, abs=1e6)


@pytest.mark.parametrize("jitter_s", [0.0, 0.003, 0.016])
@pytest.mark.parametrize(("damaged_share", "n"), [(0.01, 5000), (0.1, 2500), (0.4, 2500)])
@pytest.mark.parametrize("configured", [True, False])
def test_damaged_samples_keep_their_place_in_time(
    configured: bool, damaged_share: float, n: int, jitter_s: float
) -> None:
    """Lines are damaged on the wire, so that each rejected line was a sample."""
    rng = np.random.default_rng(6)
    good = send_samples(build_text(), n)
    damaged = rng.random(n) < damaged_share
    damaged[:100] = damaged[-1] = False
    arrived_ns = START_NS + np.arange(n) / RATE_HZ * 1e9
    arrived_ns = np.maximum.accumulate(arrived_ns + rng.uniform(0.0, 1e9 * jitter_s, n)).astype(np.int64)
    chunks = [
        [Chunk(b"1,2,x\n" if bad else chunk.data, int(t_ns))]
        for chunk, bad, t_ns in zip(good, damaged, arrived_ns, strict=True)
    ]
    driver, t_ns = receive("text", RATE_HZ if configured else None, chunks, build_text())
    counts = driver.counts
    assert (counts.received, counts.bad) == (n - damaged.sum(), damaged.sum())
    assert counts.lost <= 2
    assert driver.clock.measured_hz == pytest.approx(RATE_HZ, rel=0.005)
    error_ns = (t_ns - arrived_ns[~damaged])[n // 2 :]
    assert np.ptp(error_ns) < 1e9 * (jitter_s + 0.004)


@pytest.mark.parametrize("sigma", [0.1, 1.0, 3.0, 6.0])
def test_garbage_is_almost_never_taken_for_samples(sigma: float) -> None:
    """Wald's inequality bounds the probability of a wrong decision by exp(-5) if the variance is correct."""
    wrong = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        tested = RejectedFrameTest()
        arrived_s = np.cumsum(np.maximum(10.0 + sigma * rng.normal(size=2000), 0.0))
        rejected = rng.poisson(0.5, 2000).tolist()
        wrong += sum(tested.count_missing(t, 10, k, 1.0) for t, k in zip(arrived_s.tolist(), rejected, strict=True)) > 0
    assert wrong <= 1
