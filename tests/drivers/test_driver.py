"""One device's reader over the in-memory link: it goes on whatever happens, ends at once, and counts every sample."""

import os
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from drivers import driver as driver_module
from drivers.data_types import NO_TICK, Chunk, make_block
from drivers.decoders import dbc, stim300, text, vectornav_binary
from drivers.decoders import samples as samples_decoder
from drivers.driver import MAX_UNDECODED_BYTES, AxisMap, Driver, parse_axis_map
from drivers.errors import ConfigError
from drivers.timing.sample_clock import SampleClock
from drivers.zenoh.sample_message import encode_samples
from tests.support.loopback_link import LoopbackLink
from tests.support.settings import read_settings
from tests.support.waiting import FOREVER_S, PATIENCE_S, wait_for

RATE = 100.0


def samples(first, n, rate=RATE, tick_s=1e-9, modulus=1 << 62):
    index = np.arange(first, first + n)
    values = np.tile([0.1, -0.2, 0.3, 1.0, 2.0, 9.81], (n, 1)) + 1e-3 * index[:, None]
    ticks = np.rint(index / rate / tick_s).astype(np.int64) % modulus
    return make_block(np.zeros(n, np.int64), values, None, ticks)


class Rig:
    """A driver with its pushed blocks; a decoder of the same kind encodes."""

    def __init__(self, decoder=None, rate=RATE, axes=None, silence_s=0.0):
        self.decoder = decoder or vectornav_binary.build(vectornav_binary.Settings())
        self.encoder = vectornav_binary.build(vectornav_binary.Settings())
        self.link = LoopbackLink()
        self.pushed = []
        clock = SampleClock(self.decoder.timing, rate)
        self.driver = Driver("bench", self.link, self.decoder, clock, self.pushed.append, axes, silence_s)
        self.thread = threading.Thread(target=self.driver.run, daemon=True)
        self.sent = 0

    def send(self, n):
        for chunk in self.encoder.encode(samples(self.sent, n)):
            self.link.write(chunk.data)
        self.sent += n

    def wait(self, condition):
        wait_for(condition, lambda: f"{self.driver.state}: {self.driver.text}, {self.driver.counts}")

    def received(self, n):
        self.wait(lambda: self.driver.counts.received == n)

    def kinds(self):
        return [event.kind for event in self.driver.take_events()]


@contextmanager
def running(*args, **kwargs):
    rig = Rig(*args, **kwargs)
    rig.thread.start()
    try:
        yield rig
    finally:
        rig.driver.stop()
        rig.thread.join(PATIENCE_S)
        assert not rig.thread.is_alive()


def test_samples_come_through():
    with running() as rig:
        assert rig.driver.state == "waiting"
        assert rig.driver.text == "waiting for loopback"
        rig.send(50)
        rig.received(50)
        rig.wait(lambda: rig.driver.state == "running")
        assert rig.driver.text == ""
    values = np.concatenate([one.values for one in rig.pushed])
    assert values == pytest.approx(samples(0, 50).values, rel=1e-6)
    assert (rig.driver.counts.bad, rig.driver.counts.lost) == (0, 0)
    assert rig.kinds() == []


def test_a_link_that_is_absent_is_tried_again_with_growing_pauses():
    rig = Rig()
    tries = []
    honest = rig.link.open

    def opened():
        tries.append(time.monotonic())
        honest()

    rig.link.open = opened
    rig.link.absent = True
    rig.thread.start()
    rig.wait(lambda: len(tries) >= 4)
    assert rig.driver.state == "waiting"
    assert "nobody is at the other end" in rig.driver.text
    assert rig.driver.text.endswith("trying again")
    pauses = np.diff(tries[:4])
    assert (pauses > [0.09, 0.18, 0.38]).all()
    rig.link.absent = False
    rig.send(5)
    rig.received(5)
    rig.driver.stop()
    rig.thread.join(PATIENCE_S)
    assert rig.kinds() == []  # it never was there, so it is not back


def test_a_lost_link_is_told_and_told_when_it_is_back():
    with running() as rig:
        rig.send(20)
        rig.received(20)
        rig.link.absent = True
        rig.link.drop()
        rig.wait(lambda: rig.driver.state == "lost")
        rig.sent += 30  # the device goes on measuring
        begun = time.monotonic()
        rig.wait(lambda: time.monotonic() - begun >= 30 / RATE)  # the samples that nobody receives take so long
        rig.link.absent = False
        rig.send(20)
        rig.received(40)
        rig.wait(lambda: rig.driver.state == "running")
    assert rig.kinds() == ["link_lost", "samples_lost", "link_back"]
    assert rig.driver.counts.lost == 30


def test_silence_opens_the_link_anew():
    with running(silence_s=0.3) as rig:
        rig.send(1)
        rig.received(1)
        rig.wait(lambda: rig.driver.state == "lost")
        assert "silent for" in rig.driver.text
        rig.send(1)
        rig.wait(lambda: rig.driver.state == "running")
    assert {"link_lost", "link_back"} <= set(rig.kinds())


def test_a_replay_s_end_ends_the_reader():
    rig = Rig()
    rig.send(10)
    rig.link.end()
    rig.thread.start()
    rig.thread.join(PATIENCE_S)
    assert not rig.thread.is_alive()
    assert rig.driver.state == "ended"
    assert "end of what was written" in rig.driver.text
    assert rig.driver.counts.received == 10


@pytest.mark.parametrize("where", ["absent", "waiting", "running", "lost", "flooded", "before it began"])
def test_it_ends_at_once_from_anywhere(where, monkeypatch):
    """The pauses and the waits for data are far longer than the test, so only an interrupted wait lets it end."""
    for name in ("MIN_RETRY_PAUSE_S", "MAX_RETRY_PAUSE_S"):
        monkeypatch.setattr(driver_module, name, FOREVER_S)
    rig = Rig(silence_s=0.0)
    if where == "before it began":
        rig.driver.stop()
    rig.link.absent = where == "absent"
    rig.thread.start()
    if where in ("running", "lost"):
        rig.send(3)
        rig.received(3)
    if where == "lost":
        rig.link.absent = True
        rig.link.drop()
        rig.wait(lambda: rig.driver.state == "lost")
    if where == "flooded":
        for _ in range(20):
            rig.send(500)
    if where == "absent":
        rig.wait(lambda: "trying again" in rig.driver.text)  # it is in the pause between two attempts
    rig.driver.stop()
    rig.thread.join(PATIENCE_S)
    assert not rig.thread.is_alive()


def test_stopping_just_when_the_link_opens_still_ends():
    """A stop between the look at the flag and ``open`` must not leave an open link read for ever."""
    for _ in range(200):
        rig = Rig()
        rig.thread.start()
        rig.driver.stop()
        rig.thread.join(PATIENCE_S)
        assert not rig.thread.is_alive()


def test_bytes_without_a_sample_say_so():
    with running() as rig:
        for _ in range(30):
            rig.link.write(bytes(range(1, 200)))
        rig.wait(lambda: f"{rig.link.name}: " in rig.driver.text)
        assert "baud rate" in rig.driver.text
        assert rig.driver.state == "waiting"
        rig.send(5)
        rig.wait(lambda: rig.driver.state == "running")
        assert rig.driver.text == ""
    assert MAX_UNDECODED_BYTES < 30 * 199


def test_fifty_lost_links_leave_nothing_behind():
    with running() as rig:
        rig.send(1)
        rig.received(1)
        threads, files = (
            threading.active_count(),
            len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 0,
        )
        for i in range(50):
            rig.link.drop()
            rig.wait(lambda: rig.driver.state == "lost")
            rig.sent += 1
            rig.send(5)
            rig.wait(lambda n=5 * i + 6: rig.driver.counts.received == n and rig.driver.state == "running")
        assert threading.active_count() == threads
        assert not files or len(os.listdir("/proc/self/fd")) <= files
        kinds = rig.kinds()
        assert kinds.count("link_lost") == kinds.count("link_back") == 50
    assert rig.driver.counts.lost == 50


def damaged(frames, broken, absent):
    """The stream with a byte flipped in some frames and others left out."""
    out = []
    for i, frame in enumerate(frames):
        if i in absent:
            continue
        out.append(bytes([*frame[:9], frame[9] ^ 0x55, *frame[10:]]) if i in broken else frame)
    return b"".join(out)


@pytest.mark.parametrize("name", ["vectornav_binary", "stim300"])
@pytest.mark.parametrize("pieces", [1, 7, 1000])
def test_received_bad_and_lost_are_all_that_was_sent(name, pieces):
    module = {"vectornav_binary": vectornav_binary, "stim300": stim300}[name]
    decoder, encoder = module.build(module.Settings()), module.build(module.Settings())
    kind = decoder.timing
    n = 2000
    rng = np.random.default_rng(4)
    broken = set(rng.choice(np.arange(20, n - 5), 60, replace=False).tolist())
    absent = set(rng.choice(np.arange(20, n - 5), 80, replace=False).tolist()) - broken
    frames = [c.data for c in encoder.encode(samples(0, n, 500.0, kind.tick_s, kind.modulus))]
    data = damaged(frames, broken, absent)
    rig = Rig(decoder, 500.0)
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
    assert sum(len(one) + one.lost for one in rig.pushed) == n


def test_loss_counts_once_beside_rejected_frames_in_one_read():
    """One read with a rejected frame before its first gap, and a second gap behind."""
    rig = Rig()
    frames = [c.data for c in rig.encoder.encode(samples(0, 60))]
    rig.link.open()
    rig.link.write(b"".join(frames[:20]))
    rig.driver.read_and_push_once()
    rig.link.write(damaged(frames, {20}, {30, 31, 32})[20 * len(frames[0]) :])
    rig.driver.read_and_push_once()
    counts = rig.driver.counts
    assert (counts.received, counts.bad, counts.lost) == (56, 1, 3)


def test_messages_that_never_came_are_lost_and_rejected_ones_are_bad():
    """The sender's count tells both: here of 10 messages of 10 samples."""
    decoder = samples_decoder.build(samples_decoder.Settings())
    rig = Rig(decoder)
    t_ns = 1_700_000_000 * 10**9 + 10_000_000 * np.arange(100)
    messages = [encode_samples("a", n, make_block(t_ns[n - 10 : n], np.ones((10, 6)))) for n in range(10, 101, 10)]
    messages[3] = messages[3][:40]
    del messages[6:8]
    for message in messages:
        rig.link.write(message)
    rig.link.end()
    rig.driver.run()
    counts = rig.driver.counts
    assert (counts.received, counts.bad, counts.lost) == (70, 1, 29)  # a message that cannot be read counts as one


SIGNALS = {"gz": "AngularRateInformation.YawRate", "az": "AccelerationSensor.VerticalAcceleration"}
APART = "frames of one sample arrive 8 ms apart, more than window = 0.005 s: increase `window` in decoder_options"


def can_rig(late, n=500):
    """A driver that has read ``n`` samples of two CAN frames each, 20 ms a sample; in the late samples 8 ms apart."""
    decoder = dbc.build(read_settings(dbc.Settings, {"file": "j1939_imu", "signals": SIGNALS, "window": 0.005}))
    rig = Rig(decoder, 50.0)
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
def test_late_can_frames_are_late_samples_neither_bad_nor_sent_twice(late):
    counts = can_rig(late).driver.counts
    assert (counts.received, counts.bad, counts.lost, counts.late) == (500 - len(late), 0, len(late), len(late))


def test_late_and_missing_can_frames_add_up_with_the_samples():
    rig = can_rig(range(0), 0)
    sent = rig.decoder.encode(make_block(np.arange(100) * 20_000_000, np.ones((100, 6))))
    late, missing = {20, 21, 60}, {40, 41, 81}
    for i, chunk in enumerate(sent):
        if i // 2 in missing and i % 2 == 1:
            continue
        rig.link.write(replace(chunk, t_ns=chunk.t_ns + i % 2 * (8_000_000 if i // 2 in late else 1_000_000)))
        rig.driver.read_and_push_once()
    counts = rig.driver.counts
    assert (counts.received, counts.bad, counts.lost, counts.late) == (94, 3, 3, 3)


def test_the_status_of_a_device_whose_can_frames_are_all_late_names_the_window():
    rig = can_rig(range(500))
    assert rig.driver.state == "waiting"
    assert rig.driver.text.startswith("loopback: ")
    assert rig.driver.text.endswith(f" bytes without a sample; {APART}")


def test_times_follow_what_the_link_brings():
    rig = Rig()
    rig.link.epoch = "unix"
    assert Driver("a", rig.link, rig.decoder, rig.driver.clock, rig.pushed.append).times_are_unix
    assert not rig.driver.times_are_unix


def test_a_fault_of_the_program_does_not_look_like_a_running_device():
    rig = Rig()
    rig.send(1)

    def fail(chunks):
        raise ZeroDivisionError("of the decoder")

    rig.decoder.feed = fail
    with pytest.raises(ZeroDivisionError):
        rig.driver.run()
    assert rig.driver.state == "lost"
    assert "of the decoder" in rig.driver.text


# --- axes


def test_axes_are_mapped_with_their_signs():
    axes = parse_axis_map({"gy": "gz", "gz": "-gy", "ay": "+az", "az": "-ay"})
    with running(axes=axes) as rig:
        rig.send(1)
        rig.received(1)
    assert rig.pushed[0].values[0] == pytest.approx([0.1, 0.3, 0.2, 1.0, 9.81, -2.0], rel=1e-6)


def test_axis_map_keeps_all_else():
    first = make_block(np.arange(3), np.arange(18.0).reshape(3, 6), np.ones(3), np.arange(3), 4)
    mapped = parse_axis_map({"gx": "-gx"}).map_axes(first)
    assert (mapped.lost, mapped.ticks.tolist(), mapped.temperature_c.tolist()) == (4, [0, 1, 2], [1.0] * 3)
    assert mapped.values[:, 0].tolist() == [-0.0, -6.0, -12.0]
    assert np.array_equal(mapped.values[:, 1:], first.values[:, 1:])
    assert AxisMap().map_axes(first) is first
    assert parse_axis_map({}) == AxisMap()


@pytest.mark.parametrize("table", [{"gq": "gx"}, {"gx": "mx"}, {"gx": "--gy"}, {"gx": ""}, {"gx": "-"}])
def test_axes_that_are_none_are_refused(table):
    with pytest.raises(ConfigError, match="expected two axes of the same kind out of gx gy gz ax ay az"):
        parse_axis_map(table)


def test_an_arrival_timed_device_counts_its_rejected_lines():
    decoder = text.build(
        text.Settings(columns=["gx", "gy", "gz", "ax", "ay", "az"], gyro_unit="rad/s", accel_unit="m/s2")
    )
    rig = Rig(decoder)
    lines = [b"0.1 0.2 0.3 1 2 9.8\n"] * 50
    lines[20] = b"0.1 0.2 x.3 1 2 9.8\n"
    rig.link.write(Chunk(b"".join(lines), 10**9))
    rig.link.end()
    rig.driver.run()
    counts = rig.driver.counts
    assert (counts.received, counts.bad, counts.lost) == (48, 1, 0)  # the first line may be half a line
    assert (rig.pushed[0].ticks == NO_TICK).all()


def test_many_holes_are_told_once_a_second(monkeypatch):
    now_s = [1000.0]
    monkeypatch.setattr(driver_module, "time", SimpleNamespace(monotonic=lambda: now_s[0], monotonic_ns=lambda: 0))
    rig = Rig()
    driver = rig.driver
    for lost in (3, 2, 2):
        driver._count_samples(make_block(np.zeros(1, np.int64), np.zeros((1, 6)), lost=lost), 0)
        driver._report_lost()
    now_s[0] += 1.0
    driver._report_lost()
    driver._report_lost()
    assert [event.text for event in driver.take_events()] == ["3 samples missing", "4 samples missing in 2 places"]
    assert driver.counts.lost == 7
