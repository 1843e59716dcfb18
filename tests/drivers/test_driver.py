"""Tests of the driver of one device: reconnection, end, status texts, counts of samples, and axis map.

Most of them use the in-memory loopback link.
"""

import itertools
import os
import re
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from drivers import driver as driver_module
from drivers.data_types import NO_TICK, Chunk, make_block
from drivers.decoders import dbc
from drivers.decoders.binary_frames import (
    aceinna_dmu,
    bno08x_rvc,
    inertial_labs,
    inertial_sense,
    novatel_rawimusx,
    stim300,
    ublox_esf,
    vectornav_binary,
)
from drivers.decoders.messages import samples as samples_decoder
from drivers.decoders.text_lines import text
from drivers.driver import MAX_UNDECODED_BYTES, AxisMap, Driver, parse_axis_map
from drivers.errors import ConfigError
from drivers.timing.sample_clock import SampleClock
from drivers.zenoh.sample_message import encode_samples
from tests.support.loopback_link import LoopbackLink
from tests.support.settings import read_settings
from tests.support.waiting import FOREVER_S, PATIENCE_S, wait_for

RATE_HZ = 100.0


def make_samples(first, n, rate_hz=RATE_HZ, tick_s=1e-9, modulus=1 << 62):
    """Return the samples with the indices first … first + n - 1. Each sample differs from the others."""
    index = np.arange(first, first + n)
    values = np.tile([0.1, -0.2, 0.3, 1.0, 2.0, 9.81], (n, 1)) + 1e-3 * index[:, None]
    ticks = np.rint(index / rate_hz / tick_s).astype(np.int64) % modulus
    return make_block(np.zeros(n, np.int64), values, None, ticks)


class DriverRig:
    """A driver on a loopback link, with the blocks that it has pushed and an encoder for the data to send."""

    def __init__(self, decoder=None, rate_hz=RATE_HZ, axes=None, silence_s=0.0):
        self.decoder = decoder or vectornav_binary.build(vectornav_binary.Settings())
        self.encoder = vectornav_binary.build(vectornav_binary.Settings())
        self.link = LoopbackLink()
        self.pushed = []
        clock = SampleClock(self.decoder.timing, rate_hz)
        self.driver = Driver("bench", self.link, self.decoder, clock, self.pushed.append, axes, silence_s)
        self.thread = threading.Thread(target=self.driver.run, daemon=True)
        self.sent = 0

    def send(self, n):
        for chunk in self.encoder.encode(make_samples(self.sent, n)):
            self.link.write(chunk.data)
        self.sent += n

    def wait_until(self, condition):
        wait_for(condition, lambda: f"{self.driver.state}: {self.driver.text}, {self.driver.counts}")

    def wait_until_received(self, n):
        self.wait_until(lambda: self.driver.counts.received == n)

    def take_event_kinds(self):
        return [event.kind for event in self.driver.take_events()]


@contextmanager
def run_driver(*args, **kwargs):
    """Run the driver in a thread. Stop it at the end of the context."""
    rig = DriverRig(*args, **kwargs)
    rig.thread.start()
    try:
        yield rig
    finally:
        rig.driver.stop()
        rig.thread.join(PATIENCE_S)
        assert not rig.thread.is_alive()


def test_driver_pushes_all_samples_that_are_sent():
    with run_driver() as rig:
        assert rig.driver.state == "waiting"
        assert rig.driver.text == "waiting for loopback"
        rig.send(50)
        rig.wait_until_received(50)
        rig.wait_until(lambda: rig.driver.state == "running")
        assert rig.driver.text == ""
    values = np.concatenate([block.values for block in rig.pushed])
    assert values == pytest.approx(make_samples(0, 50).values, rel=1e-6)
    assert (rig.driver.counts.bad, rig.driver.counts.lost) == (0, 0)
    assert rig.take_event_kinds() == []


def test_driver_retries_an_unavailable_link_with_increasing_pauses():
    rig = DriverRig()
    attempt_times_s = []
    open_link = rig.link.open

    def open_and_note_time():
        attempt_times_s.append(time.monotonic())
        open_link()

    rig.link.open = open_and_note_time
    rig.link.absent = True
    rig.thread.start()
    rig.wait_until(lambda: len(attempt_times_s) >= 4)
    assert rig.driver.state == "waiting"
    assert "nobody is at the other end" in rig.driver.text
    assert rig.driver.text.endswith("trying again")
    pauses_s = np.diff(attempt_times_s[:4])
    assert (pauses_s > [0.09, 0.18, 0.38]).all()
    rig.link.absent = False
    rig.send(5)
    rig.wait_until_received(5)
    rig.driver.stop()
    rig.thread.join(PATIENCE_S)
    assert rig.take_event_kinds() == []  # no event, because the link had not been open before


def test_lost_link_and_its_return_are_reported():
    with run_driver() as rig:
        rig.send(20)
        rig.wait_until_received(20)
        rig.link.absent = True
        rig.link.drop()
        rig.wait_until(lambda: rig.driver.state == "lost")
        rig.sent += 30  # the device continues to measure
        begun = time.monotonic()
        rig.wait_until(
            lambda: time.monotonic() - begun >= 30 / RATE_HZ
        )  # the device needs this time to measure the 30 samples
        rig.link.absent = False
        rig.send(20)
        rig.wait_until_received(40)
        rig.wait_until(lambda: rig.driver.state == "running")
    assert rig.take_event_kinds() == ["link_lost", "samples_lost", "link_back"]
    assert rig.driver.counts.lost == 30


def test_silent_link_is_opened_again():
    with run_driver(silence_s=0.3) as rig:
        rig.send(1)
        rig.wait_until_received(1)
        rig.wait_until(lambda: rig.driver.state == "lost")
        assert "silent for" in rig.driver.text
        rig.send(1)
        rig.wait_until(lambda: rig.driver.state == "running")
    assert {"link_lost", "link_back"} <= set(rig.take_event_kinds())


def test_end_of_a_replay_ends_the_driver():
    rig = DriverRig()
    rig.send(10)
    rig.link.end()
    rig.thread.start()
    rig.thread.join(PATIENCE_S)
    assert not rig.thread.is_alive()
    assert rig.driver.state == "ended"
    assert "end of what was written" in rig.driver.text
    assert rig.driver.counts.received == 10


@pytest.mark.parametrize("state", ["absent", "waiting", "running", "lost", "flooded", "before its start"])
def test_driver_ends_immediately_in_every_state(state, monkeypatch):
    """Set pauses that are far longer than the test, so that the driver ends only if stopping interrupts its wait."""
    for name in ("MIN_RETRY_PAUSE_S", "MAX_RETRY_PAUSE_S"):
        monkeypatch.setattr(driver_module, name, FOREVER_S)
    rig = DriverRig(silence_s=0.0)
    if state == "before its start":
        rig.driver.stop()
    rig.link.absent = state == "absent"
    rig.thread.start()
    if state in ("running", "lost"):
        rig.send(3)
        rig.wait_until_received(3)
    if state == "lost":
        rig.link.absent = True
        rig.link.drop()
        rig.wait_until(lambda: rig.driver.state == "lost")
    if state == "flooded":
        for _ in range(20):
            rig.send(500)
    if state == "absent":
        rig.wait_until(lambda: "trying again" in rig.driver.text)  # the driver is in the pause between two attempts
    rig.driver.stop()
    rig.thread.join(PATIENCE_S)
    assert not rig.thread.is_alive()


def test_stopping_while_the_link_is_being_opened_ends_the_driver():
    """The driver must also end if it is stopped between its check of the flag and the call of ``open``."""
    for _ in range(200):
        rig = DriverRig()
        rig.thread.start()
        rig.driver.stop()
        rig.thread.join(PATIENCE_S)
        assert not rig.thread.is_alive()


def test_status_text_reports_bytes_without_a_sample():
    with run_driver() as rig:
        for _ in range(30):
            rig.link.write(bytes(range(1, 200)))
        rig.wait_until(lambda: f"{rig.link.name}: " in rig.driver.text)
        assert "baud rate" in rig.driver.text
        assert rig.driver.state == "waiting"
        rig.send(5)
        rig.wait_until(lambda: rig.driver.state == "running")
        assert rig.driver.text == ""
    assert MAX_UNDECODED_BYTES < 30 * 199


def test_fifty_lost_links_leak_no_threads_or_files():
    with run_driver() as rig:
        rig.send(1)
        rig.wait_until_received(1)
        threads, files = (
            threading.active_count(),
            len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 0,
        )
        for i in range(50):
            rig.link.drop()
            rig.wait_until(lambda: rig.driver.state == "lost")
            rig.sent += 1
            rig.send(5)
            rig.wait_until(lambda n=5 * i + 6: rig.driver.counts.received == n and rig.driver.state == "running")
        assert threading.active_count() == threads
        assert not files or len(os.listdir("/proc/self/fd")) <= files
        kinds = rig.take_event_kinds()
        assert kinds.count("link_lost") == kinds.count("link_back") == 50
    assert rig.driver.counts.lost == 50


def damage_stream(frames, broken, absent):
    """Join the frames. Invert bits in the frames ``broken`` and leave out the frames ``absent``."""
    parts = []
    for i, frame in enumerate(frames):
        if i in absent:
            continue
        parts.append(bytes([*frame[:9], frame[9] ^ 0x55, *frame[10:]]) if i in broken else frame)
    return b"".join(parts)


@pytest.mark.parametrize(
    "module",
    [vectornav_binary, stim300, aceinna_dmu, bno08x_rvc, inertial_labs, inertial_sense, novatel_rawimusx, ublox_esf],
    ids=lambda module: module.__name__.rpartition(".")[2],
)
@pytest.mark.parametrize("pieces", [1, 7, 1000])
def test_received_bad_and_lost_samples_add_up_to_the_sent_samples(module, pieces):
    decoder, encoder = module.build(module.Settings()), module.build(module.Settings())
    timing = decoder.timing
    n = 2000
    rng = np.random.default_rng(4)
    broken = set(rng.choice(np.arange(20, n - 5), 60, replace=False).tolist())
    absent = set(rng.choice(np.arange(20, n - 5), 80, replace=False).tolist()) - broken
    tick_s = timing.tick_s or 1.0 / 500.0  # a counter without a unit counts samples
    frames = [chunk.data for chunk in encoder.encode(make_samples(0, n, 500.0, tick_s, timing.modulus))]
    data = damage_stream(frames, broken, absent)
    rig = DriverRig(decoder, 500.0)
    rig.thread.start()
    for at in range(0, len(data), max(1, len(data) // pieces)):
        rig.link.write(data[at : at + max(1, len(data) // pieces)])
    rig.link.end()
    rig.thread.join(PATIENCE_S)
    counts = rig.driver.counts
    assert rig.driver.state == "ended"
    assert counts.received == n - len(broken) - len(absent)
    assert counts.received + counts.bad + counts.lost == n
    assert counts.bad == len(broken)
    assert sum(len(block) + block.lost for block in rig.pushed) == n


def test_rejected_frame_and_gap_in_one_read_are_counted_once_each():
    """The read contains a rejected frame, followed by three missing frames."""
    rig = DriverRig()
    frames = [chunk.data for chunk in rig.encoder.encode(make_samples(0, 60))]
    rig.link.open()
    rig.link.write(b"".join(frames[:20]))
    rig.driver.read_and_push_once()
    rig.link.write(damage_stream(frames, {20}, {30, 31, 32})[20 * len(frames[0]) :])
    rig.driver.read_and_push_once()
    counts = rig.driver.counts
    assert (counts.received, counts.bad, counts.lost) == (56, 1, 3)


def test_missing_messages_are_lost_and_rejected_messages_are_bad():
    """The counter of the sender shows how many samples are missing. There are 10 messages of 10 samples each."""
    decoder = samples_decoder.build(samples_decoder.Settings())
    rig = DriverRig(decoder)
    t_ns = 1_700_000_000 * 10**9 + 10_000_000 * np.arange(100)
    messages = [encode_samples("a", n, make_block(t_ns[n - 10 : n], np.ones((10, 6)))) for n in range(10, 101, 10)]
    messages[3] = messages[3][:40]
    del messages[6:8]
    for message in messages:
        rig.link.write(message)
    rig.link.end()
    rig.driver.run()
    counts = rig.driver.counts
    assert (counts.received, counts.bad, counts.lost) == (70, 1, 29)  # an unreadable message counts as one bad sample


SIGNALS = {"gz": "AngularRateInformation.YawRate", "az": "AccelerationSensor.VerticalAcceleration"}
LATE_FRAME_HINT = (
    "frames of one sample arrive 8 ms apart, more than window = 0.005 s: increase `window` in decoder_options"
)


def read_can_samples(late, n=500):
    """Return a driver that has read ``n`` samples of two CAN frames each, at 50 Hz.

    The two frames are 1 ms apart. In the samples ``late``, they are 8 ms apart.
    """
    decoder = dbc.build(read_settings(dbc.Settings, {"file": "j1939_imu", "signals": SIGNALS, "window": 0.005}))
    rig = DriverRig(decoder, 50.0)
    index = np.arange(n)
    sent = decoder.encode(make_block(index * 20_000_000, np.tile([0.0, 0.0, 0.1, 0.0, 0.0, 9.81], (n, 1))))
    rig.link.open()
    for i, chunk in enumerate(sent):
        delay_ns = i % 2 * (8_000_000 if i // 2 in late else 1_000_000)
        rig.link.write(replace(chunk, t_ns=chunk.t_ns + delay_ns))
        if i % 3 == 0:
            rig.driver.read_and_push_once()
    rig.driver.read_and_push_once()
    return rig


@pytest.mark.parametrize("late", [range(0), range(7, 500, 7), range(100, 300), range(499, 500), range(500)])
def test_sample_with_a_late_can_frame_counts_as_late_and_not_as_bad(late):
    counts = read_can_samples(late).driver.counts
    assert (counts.received, counts.bad, counts.lost, counts.late) == (500 - len(late), 0, len(late), len(late))


def test_received_late_and_missing_can_samples_add_up():
    rig = read_can_samples(range(0), 0)
    sent = rig.decoder.encode(make_block(np.arange(100) * 20_000_000, np.ones((100, 6))))
    late, missing = {20, 21, 60}, {40, 41, 81}
    for i, chunk in enumerate(sent):
        if i // 2 in missing and i % 2 == 1:
            continue
        rig.link.write(replace(chunk, t_ns=chunk.t_ns + i % 2 * (8_000_000 if i // 2 in late else 1_000_000)))
        rig.driver.read_and_push_once()
    counts = rig.driver.counts
    assert (counts.received, counts.bad, counts.lost, counts.late) == (94, 3, 3, 3)


def test_status_text_names_the_window_if_all_can_frames_are_late():
    rig = read_can_samples(range(500))
    assert rig.driver.state == "waiting"
    assert rig.driver.text.startswith("loopback: ")
    assert rig.driver.text.endswith(f" bytes without a sample; {LATE_FRAME_HINT}")


def test_status_names_the_decoder_that_fits_undecoded_bytes():
    encoder = stim300.build(stim300.Settings())
    with run_driver() as rig:
        for chunk in encoder.encode(make_samples(0, 200, tick_s=1.0, modulus=256)):
            rig.link.write(chunk.data)
        rig.wait_until(lambda: 'the bytes fit decoder = "stim300"' in rig.driver.text)
        rig.send(50)
        rig.wait_until(lambda: rig.driver.state == "running" and not rig.driver.text)


@pytest.mark.parametrize(
    ("configured", "sent", "hint"),
    [
        ({"packet": "S1"}, {"packet": "S0"}, 'the bytes fit decoder_options = { packet = "S0" }'),
        ({"packet": "z1"}, {}, "the bytes fit the default decoder_options"),
    ],
)
def test_status_names_the_options_that_fit_undecoded_bytes(configured, sent, hint):
    encoder = aceinna_dmu.build(aceinna_dmu.Settings(**sent))
    with run_driver(aceinna_dmu.build(aceinna_dmu.Settings(**configured))) as rig:
        for chunk in encoder.encode(make_samples(0, 200, tick_s=1.0, modulus=256)):
            rig.link.write(chunk.data)
        rig.wait_until(lambda: hint in rig.driver.text)


def test_status_counts_the_rejected_lines_and_names_the_pattern_that_fits():
    with run_driver(text.build(text.Settings(columns=["gx", "gy", "gz", "ax", "ay", "az", "temperature"]))) as rig:
        for i in range(200):
            rig.link.write(b"A:0.1,0.2,9.8 G:0.01,0.02,0.0%d T:25.%d\n" % (i % 7, i % 10))
        rig.wait_until(lambda: "(?P<ax>" in rig.driver.text)
        assert re.search(r"\d+ lines or frames rejected since \d\d:\d\d:\d\d; a line has 5 columns", rig.driver.text)


def test_times_are_unix_if_the_link_has_unix_times():
    rig = DriverRig()
    rig.link.epoch = "unix"
    assert Driver("a", rig.link, rig.decoder, rig.driver.clock, rig.pushed.append).times_are_unix
    assert not rig.driver.times_are_unix


def test_reader_continues_after_an_unexpected_exception(monkeypatch):
    monkeypatch.setattr(driver_module, "MAX_RETRY_PAUSE_S", 0.01)

    def fail(chunks):
        raise ZeroDivisionError("of the decoder")

    with run_driver() as rig:
        rig.decoder.feed = fail
        rig.send(1)
        wait_for(lambda: "of the decoder" in rig.driver.text)
        assert rig.driver.state == "lost"
        assert isinstance(rig.driver.unexpected_error, ZeroDivisionError)
        del rig.decoder.feed
        wait_for(lambda: rig.send(1) or rig.driver.state == "running")


# --- axes


def test_axis_map_permutes_axes_and_changes_signs():
    axes = parse_axis_map({"gy": "gz", "gz": "-gy", "ay": "+az", "az": "-ay"})
    with run_driver(axes=axes) as rig:
        rig.send(1)
        rig.wait_until_received(1)
    assert rig.pushed[0].values[0] == pytest.approx([0.1, 0.3, 0.2, 1.0, 9.81, -2.0], rel=1e-6)


def test_axis_map_changes_nothing_else():
    first = make_block(np.arange(3), np.arange(18.0).reshape(3, 6), np.ones(3), np.arange(3), 4)
    mapped = parse_axis_map({"gx": "-gx"}).map_axes(first)
    assert (mapped.lost, mapped.ticks.tolist(), mapped.temperature_c.tolist()) == (4, [0, 1, 2], [1.0] * 3)
    assert mapped.values[:, 0].tolist() == [-0.0, -6.0, -12.0]
    assert np.array_equal(mapped.values[:, 1:], first.values[:, 1:])
    assert AxisMap().map_axes(first) is first
    assert parse_axis_map({}) == AxisMap()


@pytest.mark.parametrize("table", [{"gq": "gx"}, {"gx": "mx"}, {"gx": "--gy"}, {"gx": ""}, {"gx": "-"}])
def test_unknown_axes_are_refused(table):
    with pytest.raises(ConfigError, match="expected two axes of the same kind out of gx gy gz ax ay az"):
        parse_axis_map(table)


def test_every_axis_map_is_a_signed_permutation_or_names_the_key_and_the_lost_axis():
    axes = ("gx", "gy", "gz")
    for words in itertools.product(axes, repeat=3):
        for signs in itertools.product(("", "-"), repeat=3):
            for omitted in ((), ("gx",), ("gy", "gz")):
                table = {axis: sign + word for axis, sign, word in zip(axes, signs, words, strict=True)}
                used = [axis if axis in omitted else word for axis, word in zip(axes, words, strict=True)]
                table = {axis: word for axis, word in table.items() if axis not in omitted}
                if len(set(used)) == 3:
                    assert sorted(parse_axis_map(table).source) == [0, 1, 2, 3, 4, 5]
                    continue
                with pytest.raises(ConfigError) as refusal:
                    parse_axis_map(table)
                (line,) = refusal.value.mistake_lines
                assert all(f'{axis} = "{word}"' in line for axis, word in table.items() if used.count(word[-2:]) > 1)
                assert all(axis in line.partition(", and ")[2] for axis in set(axes) - set(used))


def test_rejected_lines_of_an_arrival_timed_device_are_counted():
    decoder = text.build(
        text.Settings(columns=["gx", "gy", "gz", "ax", "ay", "az"], gyro_unit="rad/s", accel_unit="m/s2")
    )
    rig = DriverRig(decoder)
    lines = [b"0.1 0.2 0.3 1 2 9.8\n"] * 50
    lines[20] = b"0.1 0.2 x.3 1 2 9.8\n"
    rig.link.write(Chunk(b"".join(lines), 10**9))
    rig.link.end()
    rig.driver.run()
    counts = rig.driver.counts
    assert (counts.received, counts.bad, counts.lost) == (
        48,
        1,
        0,
    )  # the first line may be incomplete, so it is dropped
    assert (rig.pushed[0].ticks == NO_TICK).all()


def test_gaps_are_reported_once_per_second(monkeypatch):
    now_s = [1000.0]
    monkeypatch.setattr(driver_module, "time", SimpleNamespace(monotonic=lambda: now_s[0], monotonic_ns=lambda: 0))
    rig = DriverRig()
    driver = rig.driver
    for lost in (3, 2, 2):
        driver._count_samples(make_block(np.zeros(1, np.int64), np.zeros((1, 6)), lost=lost), 0)
        driver._report_lost()
    now_s[0] += 1.0
    driver._report_lost()
    driver._report_lost()
    assert [event.text for event in driver.take_events()] == ["3 samples missing", "4 samples missing"]
    assert driver.counts.lost == 7


def test_report_of_missing_samples_names_dropped_datagrams(monkeypatch):
    now_s = [1000.0]
    monkeypatch.setattr(driver_module, "time", SimpleNamespace(monotonic=lambda: now_s[0], monotonic_ns=lambda: 0))
    rig = DriverRig()
    driver = rig.driver
    for dropped in (2, 2, 5):
        driver._polled = SimpleNamespace(dropped_datagrams=dropped)
        driver._count_samples(make_block(np.zeros(1, np.int64), np.zeros((1, 6)), lost=9), 0)
        driver._report_lost()
        now_s[0] += 1.0
    text = "9 samples missing; {} datagrams were dropped because the receive buffer was full"
    assert [event.text for event in driver.take_events()] == [text.format(2), "9 samples missing", text.format(3)]
