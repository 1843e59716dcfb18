"""One device inside the service: when what is published, and that nothing is left out of the last estimate."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from drivers.data_types import concatenate_blocks, make_block
from drivers.decoders import dbc, samples, text, vectornav_binary
from drivers.errors import ConfigError
from drivers.links import replay_link
from monitor.daemon.device import device_worker
from monitor.daemon.device.device_worker import DeviceWorker
from monitor.daemon.kernels.kernel_readiness import KernelReadiness
from monitor.drift.compensation.live_compensation import MeasuredAndSubtractedDrift
from monitor.drift.thermal.live_thermal import ThermalIntervalResult
from monitor.estimation.detection.comparison_with_noise_model import ModelComparison
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficient_values import Status
from monitor.publishing.messages.results import TotalAndHadamardCurves
from monitor.settings import loading as settings
from monitor.settings.loading import BuiltLinkAndDecoder, Device
from tests.support.loopback_link import LoopbackLink
from tests.support.settings import read_settings
from tests.support.waiting import PATIENCE_S, wait_for

RATE = 100.0


class Caught:
    """An output that keeps everything."""

    def __init__(self):
        self.blocks, self.counts, self.estimates, self.events, self.healths, self.totals = [], [], [], [], [], []
        self.gaps, self.thermals = [], []
        self.rates, self.drifts = [], []
        self.total_times, self.health_times = [], []

    def publish_samples(self, device, received, samples, offset_ns):
        self.blocks.append(samples)
        self.counts.append(received)

    def publish_result(self, device, unix_s, received, result):
        kept = {
            Estimate: self.estimates,
            ModelComparison: self.gaps,
            ThermalIntervalResult: self.thermals,
            MeasuredAndSubtractedDrift: self.drifts,
        }
        if isinstance(result, TotalAndHadamardCurves):
            self.totals.append((received, *result))
            self.total_times.append(unix_s)
        else:
            kept[type(result)].append((unix_s, result))

    def publish_drift_compensated_samples(self, device, received, samples, offset_ns):
        self.rates.append(samples)

    def publish_event(self, device, unix_s, received, event):
        self.events.append((unix_s, event))

    def publish_health(self, device, unix_s, health):
        self.healths.append(health)
        self.health_times.append(unix_s)


class Rig:
    def __init__(
        self,
        rate=RATE,
        window_s=20.0,
        refit_s=0.1,
        publish_s=0.1,
        tau="octave",
        decoder=None,
        ready=None,
        model=None,
        thermal_s=600.0,
        compensate=True,
        link=None,
    ):
        decoder = decoder or vectornav_binary.build(vectornav_binary.Settings())
        self.link = link or LoopbackLink()
        device = Device.model_construct(
            name="bench",
            rate_hz=rate,
            window_s=window_s,
            tau=tau,
            refit_s=refit_s,
            publish_s=publish_s,
            driver=BuiltLinkAndDecoder(self.link, decoder, silence_s=0.0),
            model=model,
            thermal_s=thermal_s,
            compensate=compensate,
        )
        self.wake = threading.Event()
        self.ready = ready or KernelReadiness()
        if ready is None:
            self.ready.window.set()
            self.ready.fit.set()
            self.ready.all.set()
        self.caught = Caught()
        self.station = DeviceWorker(device, self.link, [self.caught], self.wake, self.ready)
        self.sent = self.stamped = 0
        self.link.open()

    def bring(self, n, lost=0, scale=1.0):
        """As the reader would push them; the times are the host's."""
        self.sent += lost
        index = np.arange(self.sent, self.sent + n)
        self.sent += n
        values = 1e-3 * scale * np.random.default_rng(self.sent).standard_normal((n, 6))
        samples = make_block(index * 10_000_000, values, 20.0 + 1e-3 * index, index, lost)
        self.station.driver.counts.received += n
        self.station._push(samples)

    def work(self, now_s, drain=False):
        self.station.process_new_samples(now_s, drain)

    def finish_models(self):
        """Wait for the thread that finds a model of drift: samples come far faster here than those of a sensor."""
        for thread in threading.enumerate():
            if thread.name == self.station.pipeline.arma_worker._name:
                thread.join(PATIENCE_S)


def test_drained_everything_is_out_and_the_estimate_covers_it():
    rig = Rig(refit_s=10.0, publish_s=10.0)
    rig.work(1000.0)
    for i in range(30):
        rig.bring(50)
        rig.work(1000.0 + 0.1 * i)
    rig.bring(7)
    rig.work(1003.0, drain=True)
    assert sum(len(one) for one in rig.caught.blocks) == 1507 == rig.caught.counts[-1]
    assert np.array_equal(np.concatenate([one.t_ns for one in rig.caught.blocks]), np.arange(1507) * 10_000_000)
    _, last = rig.caught.estimates[-1]
    assert (last.samples, last.curve.n, last.t_ns) == (1507, 1507, 15_060_000_000)


def test_a_running_device_whose_can_frames_are_late_says_so():
    signals = {"gz": "AngularRateInformation.YawRate", "az": "AccelerationSensor.VerticalAcceleration"}
    settings = {"file": "j1939_imu", "signals": signals, "window": 0.005}
    decoder = dbc.build(read_settings(dbc.Settings, settings))
    rig = Rig(rate=50.0, decoder=decoder)
    sent = decoder.encode(make_block(np.arange(50) * 20_000_000, np.ones((50, 6))))
    for i, chunk in enumerate(sent):
        delay_ns = i % 2 * (8_000_000 if i // 2 == 30 else 1_000_000)
        rig.link.write(replace(chunk, t_ns=chunk.t_ns + delay_ns))
    rig.station.driver.read_and_push_once()
    health = rig.station.status.build_health({}, 0)
    assert health.state == "running"
    assert (health.received, health.bad, health.lost, health.late) == (49, 0, 1, 1)
    assert health.text == (
        "frames of one sample arrive 8 ms apart, more than window = 0.005 s: increase `window` in decoder_options"
    )


def test_refits_and_publications_keep_their_beat():
    rig = Rig(refit_s=0.5, publish_s=2.0)
    for i in range(1000):
        rig.bring(1)
        rig.work(1000.0 + 0.01 * i)
    assert 4 <= len(rig.caught.estimates) <= 6
    # raw samples go on in short batches
    assert 80 <= len(rig.caught.blocks) <= 110
    assert sum(map(len, rig.caught.blocks)) >= 985


def test_every_sample_and_every_block():
    rig = Rig(refit_s=0.0, publish_s=0.0)
    rig.bring(20)
    rig.work(1000.0)
    for i in range(30):
        rig.bring(1)
        rig.work(1000.001 + 0.0001 * i)
    assert len(rig.caught.estimates) == 31
    assert [estimate.samples for _, estimate in rig.caught.estimates] == list(range(20, 51))
    assert len(rig.caught.blocks) == 31


def test_no_sample_is_missing_from_the_courses_that_are_published():
    rig = Rig(refit_s=0.0, publish_s=0.5)
    for i in range(200):
        rig.bring(5)
        rig.work(1000.0 + 0.05 * i)
    rig.work(1010.0, drain=True)
    assert 18 <= len(rig.caught.estimates) <= 22
    t_ns = np.concatenate([estimate.history.t_ns for _, estimate in rig.caught.estimates])
    assert np.array_equal(t_ns, np.arange(1000) * 10_000_000)


def test_a_fit_at_every_sample_waits_for_its_kernels():
    ready = KernelReadiness(interpretable_hz=0.0)
    ready.window.set()
    rig = Rig(refit_s=0.0, publish_s=0.0, ready=ready)
    rig.bring(300)
    rig.work(1000.0)
    assert (rig.caught.blocks, rig.caught.estimates) == ([], [])
    ready.fit.set()
    rig.work(1000.05)
    assert rig.caught.estimates == []
    ready.all.set()
    rig.work(1000.1)
    assert rig.caught.estimates[-1][1].history.t_ns.size == 300


def test_a_pause_is_not_made_up_for():
    rig = Rig(refit_s=0.1, publish_s=0.1)
    rig.bring(50)
    rig.work(1000.0)
    for i in range(20):
        rig.bring(1)
        rig.work(2000.0 + 0.001 * i)
    assert len(rig.caught.estimates) == 2


def test_nothing_new_is_not_published_again():
    rig = Rig(refit_s=0.0, publish_s=0.0)
    rig.bring(20)
    for i in range(5):
        rig.work(1000.0 + i)
    assert (len(rig.caught.estimates), len(rig.caught.blocks)) == (1, 1)


def test_samples_wait_for_a_rate_and_none_is_left_out():
    lines = text.Settings(columns=("gx", "gy", "gz", "ax", "ay", "az"))
    rig = Rig(rate=None, decoder=text.build(lines))
    rig.bring(300)
    rig.work(1000.0)
    assert rig.caught.estimates == []
    assert rig.caught.blocks == []
    for i in range(400):  # the clock learns from what the reader stamps
        t_ns = np.array([10**12 + i * 10_000_000])
        rig.station.clock.assign_times(make_block(t_ns, np.zeros((1, 6))))
    rig.bring(100)
    rig.work(1001.0)
    assert sum(map(len, rig.caught.blocks)) == 400
    (_, found) = rig.caught.estimates[-1]
    assert (found.samples, found.curve.n, found.rate_hz) == (400, 400, 100.0)


@pytest.mark.long
def test_a_rate_known_better_is_the_new_label():
    lines = text.Settings(columns=("gx", "gy", "gz", "ax", "ay", "az"))
    rig = Rig(rate=None, decoder=text.build(lines))
    t_ns = 10**12
    for _ in range(300):
        t_ns += 10_300_000
        rig.station.clock.assign_times(make_block(np.array([t_ns]), np.zeros((1, 6))))
    rig.bring(500)
    rig.work(1000.0, drain=True)
    before = rig.caught.estimates[-1][1]
    for _ in range(60_000):
        t_ns += 10_000_000
        rig.station.clock.assign_times(make_block(np.array([t_ns]), np.zeros((1, 6))))
    rig.station.slew_and_publish_status({}, 0)
    rig.bring(1)
    rig.work(1001.0, drain=True)
    after = rig.caught.estimates[-1][1]
    assert before.rate_hz == pytest.approx(97.087, rel=1e-4)
    assert after.rate_hz == 100.0
    assert np.array_equal(after.curve.factors, before.curve.factors)
    assert after.curve.n == 501


def test_reset_empties_the_window():
    rig = Rig()
    rig.station.empty_window()
    rig.bring(500)
    rig.work(1000.0, drain=True)
    rig.station.empty_window()
    rig.bring(30)
    rig.work(1001.0, drain=True)
    assert rig.caught.estimates[-1][1].curve.n == 30
    assert rig.caught.estimates[-1][1].samples == 530


def test_missing_samples_keep_their_place_and_more_than_the_window_empty_it():
    rig = Rig(window_s=5.0)
    rig.bring(300)
    rig.bring(50, lost=20)
    rig.work(1000.0, drain=True)
    assert rig.caught.estimates[-1][1].curve.n == 370
    rig.bring(40, lost=10_000)
    rig.work(1001.0, drain=True)
    assert rig.caught.estimates[-1][1].curve.n == 40


def test_a_tau_that_does_not_fit_the_rate_found_is_said_and_samples_go_on():
    rig = Rig(rate=1000.0, window_s=0.1, tau=(5.0,))
    rig.bring(300)
    rig.work(1000.0, drain=True)
    assert sum(map(len, rig.caught.blocks)) == 300
    assert rig.caught.estimates == []
    rig.station.driver.state, rig.station.driver.text = "running", ""
    assert "tau: none of [5.0] s" in rig.station.status.build_health({}, 0).text


def test_latency_counts_from_the_oldest_unpublished_sample():
    rig = Rig(refit_s=10.0, publish_s=10.0)
    rig.bring(10)
    rig.work(1000.0)  # goes out at once
    rig.station.status.build_health({}, 0)
    rig.bring(1)
    rig.work(1000.01)  # taken, but its batch waits
    time.sleep(0.05)
    rig.bring(1)
    rig.work(1000.2)
    health = rig.station.status.build_health({}, 0)
    assert health.latency_p50_s >= 0.05
    assert rig.station.status.build_health({}, 0).latency_p50_s is None


def test_overflow_is_counted_and_travels_as_loss():
    rig = Rig()
    capacity = rig.station.ring.capacity
    rig.bring(capacity)
    rig.bring(100)
    rig.work(1000.0, drain=True)
    assert rig.station.status.build_health({}, 0).overflowed == 100
    assert rig.caught.blocks[0].lost == 100
    assert sum(map(len, rig.caught.blocks)) == capacity


def test_through_the_reader_s_thread_to_the_end_of_a_replay():
    rig, begun_s = Rig(), time.time()
    encoder = vectornav_binary.build(vectornav_binary.Settings())
    index = np.arange(400)
    made = make_block(index, np.random.default_rng(0).standard_normal((400, 6)), None, index * 10_000_000)
    for chunk in encoder.encode(made):
        rig.link.write(chunk.data)
    rig.link.end()
    rig.station.start_reader_and_resume_recording()
    wait_for(lambda: rig.work(time.monotonic()) or rig.station.replay_finished, "the end of the replay")
    rig.station.stop()
    assert rig.station.join_reader_thread(PATIENCE_S)
    rig.work(time.monotonic(), drain=True)
    assert sum(map(len, rig.caught.blocks)) == 400
    assert rig.caught.estimates[-1][1].samples == 400
    assert rig.station.slew_and_publish_status({"zenoh": "ok"}, 7).received == 400
    assert (rig.caught.healths[-1].state, rig.caught.healths[-1].memory_bytes) == ("ended", 7)
    assert rig.wake.is_set()
    # Unix time of samples stamped by the monotonic clock
    assert begun_s - 5.0 <= rig.caught.estimates[-1][0] <= time.time() + 5.0


def test_a_rate_off_the_configured_one_is_said():
    rig = Rig(rate=100.0)
    for i in range(400):
        rig.station.clock.assign_times(make_block(np.array([10**12 + i * 20_000_000]), np.zeros((1, 6))))
    rig.station.driver.state, rig.station.driver.text = "running", ""
    said = (
        "measured rate 50 Hz differs from the configured 100 Hz; coefficients are withheld: correct `rate` or remove it"
    )
    assert rig.station.status.build_health({}, 0).text == said
    rig.station.driver.state, rig.station.driver.text = "ended", "x.csv: the end of the file."
    assert rig.station.status.build_health({}, 0).text == f"x.csv: the end of the file; {said}"


def stamp(rig, n, rate_hz, rng):
    """The clock sees what the reader would have: samples that arrive with jitter of up to 20 ms."""
    at, rig.stamped = rig.stamped, rig.stamped + n
    arrived_s = (at + np.arange(n)) / rate_hz + rng.uniform(0.0, 0.02, n)
    for t_ns in np.maximum.accumulate(10**12 + np.rint(arrived_s * 1e9).astype(np.int64)):
        rig.station.clock.assign_times(make_block(np.array([t_ns]), np.zeros((1, 6))))


def statuses(estimate):
    return set(estimate.coefficients.status.ravel().tolist())


def test_nothing_is_estimated_by_a_rate_that_the_device_contradicts(tmp_path):
    lines = text.Settings(columns=("gx", "gy", "gz", "ax", "ay", "az"))
    rig, rng = Rig(rate=200.0, decoder=text.build(lines), model=model_file(tmp_path)), np.random.default_rng(1)
    for i in range(20):
        stamp(rig, 50, 100.0, rng)
        rig.bring(50)
        rig.work(1000.0 + i)
    rig.station.slew_and_publish_status({}, 0)
    rig.work(1100.0, drain=True)
    estimates = [estimate for _, estimate in rig.caught.estimates]
    assert len(estimates) > 10
    assert set().union(*map(statuses, estimates)) == {Status.UNESTIMATED}
    last = estimates[-1]
    assert not np.isfinite(last.fitted).any()
    # the curve is there, at averaging times by the measured rate
    assert last.rate_hz == pytest.approx(100.0, rel=0.01)
    assert last.curve.tau_s == pytest.approx(last.curve.factors / last.rate_hz)
    assert np.isfinite(last.curve.avar[0]).all()
    assert [gap.axes for _, gap in rig.caught.gaps] == [{}] * len(rig.caught.gaps)
    assert len(rig.caught.gaps) > 10
    assert rig.caught.events == []


def test_a_rate_that_is_nearly_right_is_estimated_by():
    lines = text.Settings(columns=("gx", "gy", "gz", "ax", "ay", "az"))
    rig, rng = Rig(rate=100.2, decoder=text.build(lines)), np.random.default_rng(1)
    for i in range(20):
        stamp(rig, 50, 100.0, rng)
        rig.bring(50)
        rig.work(1000.0 + i)
    _, last = rig.caught.estimates[-1]
    assert Status.ESTIMATED in statuses(last)
    assert last.rate_hz == 100.2
    rig.station.driver.state, rig.station.driver.text = "running", ""
    assert rig.station.status.build_health({}, 0).text == ""


def test_a_rate_within_an_oscillator_s_tolerance_gives_way_to_the_measured_one():
    lines = text.Settings(columns=("gx", "gy", "gz", "ax", "ay", "az"))
    rig, rng = Rig(rate=100.0, decoder=text.build(lines)), np.random.default_rng(1)
    for i in range(80):
        stamp(rig, 50, 98.8, rng)
        rig.bring(50)
        rig.work(1000.0 + i)
        rig.station.slew_and_publish_status({}, 0)
    _, last = rig.caught.estimates[-1]
    assert Status.ESTIMATED in statuses(last)
    assert last.rate_hz == pytest.approx(98.8, rel=2e-3)


def test_coefficients_wait_until_the_rate_is_checked_and_come_back_when_it_is_right_again():
    lines = text.Settings(columns=("gx", "gy", "gz", "ax", "ay", "az"))
    rig, rng = Rig(rate=100.0, decoder=text.build(lines)), np.random.default_rng(1)
    stamp(rig, 100, 100.0, rng)
    rig.bring(1000)
    rig.work(1000.0)
    assert statuses(rig.caught.estimates[-1][1]) == {Status.UNESTIMATED}
    stamp(rig, 200, 100.0, rng)
    rig.work(1001.0)  # no new sample, but the rate is known to be right
    assert Status.ESTIMATED in statuses(rig.caught.estimates[-1][1])


def test_captured_bytes_and_fast_simulations_have_no_times_of_arrival(tmp_path):
    capture = tmp_path / "x.bin"
    capture.write_bytes(b"")
    link = replay_link.build(replay_link.Settings(path=str(capture)))
    lines = text.build(text.Settings(columns=("gx", "gy", "gz", "ax", "ay", "az")))
    rig = Rig(rate=100.0, decoder=lines, link=link, ready=KernelReadiness())
    link.close()
    stamp(rig, 600, 5000.0, np.random.default_rng(1))
    assert not rig.station.clock.rate_check_pending
    assert rig.station.clock.contradicting_rate_hz is None
    config = tmp_path / "config.toml"
    config.write_text(
        '[[device]]\nname = "d"\nrate = 100.0\n[device.driver]\nlink = "virtual"\ndecoder = "text"\nspeed = 30\n'
        '[device.driver.decoder_options]\ncolumns = ["gx", "gy", "gz"]\n'
    )
    (device,) = settings.load_config(config).devices
    station = DeviceWorker(device, LoopbackLink(), [], threading.Event(), KernelReadiness())
    for i in range(9000):
        station.clock.assign_times(make_block(np.array([10**12 + i * 333_333]), np.zeros((1, 6))))
    assert not station.clock.rate_check_pending
    assert station.clock.contradicting_rate_hz is None


def test_a_replay_has_ended_when_its_samples_are_fitted():
    rig = Rig(ready=KernelReadiness(interpretable_hz=0.0))
    rig.bring(300)
    rig.work(1000.0)
    rig.station.driver.state = "ended"
    assert not rig.station.replay_finished
    rig.ready.window.set()
    rig.work(1001.0)
    assert rig.caught.estimates[-1][1].coefficients.status.max() == 0  # the curve alone
    assert not rig.station.replay_finished
    rig.ready.fit.set()
    rig.work(1002.0)
    assert rig.caught.estimates[-1][1].coefficients.status.max() > 0
    assert rig.station.pipeline.signal_monitor is None
    rig.ready.all.set()
    assert rig.station.replay_finished
    rig.bring(10)
    rig.work(1003.0)
    assert rig.station.pipeline.signal_monitor is not None


def test_at_a_low_rate_everything_is_there_before_the_kernels_are_compiled():
    rig = Rig(rate=100.0, ready=KernelReadiness())
    rig.bring(300)
    rig.work(1000.0)
    assert rig.caught.estimates[-1][1].coefficients.status.max() > 0
    assert rig.station.pipeline.signal_monitor is not None
    rig.station.driver.state = "running"
    rig.ready.progress = "compiling 2 of 8: fit"
    assert rig.station.status.build_health({}, 0).text == "compiling 2 of 8: fit; no sample is lost"


def test_interpreted_fits_come_once_a_second_and_compiled_ones_as_configured():
    ready = KernelReadiness()
    rig = Rig(rate=100.0, ready=ready)
    for i in range(40):
        rig.bring(10)
        rig.work(1000.0 + 0.1 * i)
    assert 4 <= len(rig.caught.estimates) <= 5
    ready.fit.set()
    for i in range(40, 80):
        rig.bring(10)
        rig.work(1000.0 + 0.1 * i)
    assert len(rig.caught.estimates) >= 34


@pytest.mark.parametrize("setting", [{"rate": 1000.0}, {"refit_s": 0.0}])
def test_a_high_rate_or_a_fit_at_every_sample_waits_for_compiled_kernels(setting):
    rig = Rig(ready=KernelReadiness(), **setting)
    rig.bring(300)
    rig.work(1000.0)
    assert rig.caught.blocks == []


def test_devices_are_interpreted_until_their_rates_add_up_to_the_limit():
    ready = KernelReadiness(interpretable_hz=250.0)
    rigs = [Rig(rate=100.0, ready=ready) for _ in range(3)]
    for rig in rigs:
        rig.bring(300)
        rig.work(1000.0)
        rig.work(1001.0)
    assert [len(rig.caught.blocks) for rig in rigs] == [1, 1, 0]


def test_samples_whose_rate_cannot_be_told_go_on():
    lines = text.Settings(columns=("gx", "gy", "gz", "ax", "ay", "az"))
    rig = Rig(rate=None, decoder=text.build(lines))
    rig.bring(40_000)
    rig.work(1000.0)
    assert sum(map(len, rig.caught.blocks)) == 40_000
    assert rig.caught.estimates == []
    rig.station.driver.state, rig.station.driver.text = "running", ""
    assert (
        rig.station.status.build_health({}, 0).text
        == "no estimate: the times of the samples do not show a rate; set `rate`"
    )


def model_file(folder):
    """White noise as ``Rig.bring`` has it."""
    path = folder / "mine.toml"
    path.write_text('["g*".angle_random_walk]\nN = 1e-4\n["a*".angle_random_walk]\nN = 1e-4\n')
    return path


def test_the_window_is_held_against_the_model_in_force(tmp_path):
    rig = Rig(model=model_file(tmp_path))
    for i in range(30):
        rig.bring(50)
        rig.work(1000.0 + 0.5 * i)
    unix_s, look = rig.caught.gaps[-1]
    assert (unix_s, look.samples) == (rig.caught.estimates[-1][0], 1500)
    assert len(rig.caught.gaps) == len(rig.caught.estimates)
    assert rig.caught.gaps[0][1].axes == {}  # too few yet
    assert look.agrees == dict.fromkeys(look.axes, True)
    assert len(look.axes) == 6
    assert not any(one.gap > one.threshold for one in look.axes.values())
    assert rig.caught.events == []


@pytest.mark.long
def test_the_moment_it_disagrees_is_an_event_and_so_is_the_return(tmp_path):
    rig = Rig(window_s=20.0, model=model_file(tmp_path))
    told = {}
    for i in range(240):
        rig.bring(50, scale=1.5 if 60 <= i < 100 else 1.0)
        rig.work(1000.0 + 0.5 * i)
        for _, event in rig.caught.events:
            if event.kind == "model_disagrees":
                told.setdefault((event.axis, event.values["model"]["agrees"]), i)
    assert {axis for axis, _ in told} == {"gx", "gy", "gz", "ax", "ay", "az"}
    assert all(60 < i < 100 for (_, agrees), i in told.items() if not agrees)
    assert sum(1 for _, agrees in told if agrees) == 6
    assert all(i > 100 for (_, agrees), i in told.items() if agrees)
    assert set(rig.caught.gaps[-1][1].agrees.values()) == {True}


def follow_temperature(rig, seconds, begin_s=0.0):
    """Samples whose bias follows a temperature that swings by 2 °C in 50 s, a tenth of a second at a time."""
    for i in range(round(10 * seconds)):
        index = np.arange(rig.sent, rig.sent + 10)
        rig.sent += 10
        warmth = 25.0 + np.sin(2.0 * np.pi * index / 5000.0)
        values = 1e-3 * np.random.default_rng(rig.sent).standard_normal((10, 6)) + 2e-3 * (warmth - 25.0)[:, None]
        rig.station._push(make_block(index * 10_000_000, values, warmth, index))
        rig.work(begin_s + 0.1 * i)


@pytest.mark.long
def test_bias_is_held_against_temperature():
    rig = Rig(thermal_s=1.0)
    follow_temperature(rig, 30.0)
    while rig.station.pipeline.thermal.run_selection_step_if_active():  # until the models are chosen
        pass
    follow_temperature(rig, 3.0, 100.0)
    assert len(rig.caught.thermals) >= 31
    unix_s, look = rig.caught.thermals[-1]
    assert unix_s == rig.station.timeline.to_unix_s(look.t_ns)
    assert set(look.axes) == {"gx", "gy", "gz", "ax", "ay", "az"}
    last = look.axes["gz"]
    assert last.one_step.bias == pytest.approx(last.bias, abs=5e-4)
    assert last.slope == pytest.approx(2e-3, rel=0.3)


def test_choosing_a_model_holds_no_round_up(monkeypatch):
    monkeypatch.setattr(device_worker, "MODEL_SELECTION_S", 0.0)  # a step each time, however fast the machine is
    rig = Rig(thermal_s=1.0)
    follow_temperature(rig, 14.0)
    assert rig.station.pipeline.thermal.is_selecting_model
    for i in range(50):
        rig.work(100.0 + i)
    assert rig.station._can_take()  # a sensor never waits


@pytest.mark.long
def test_a_recording_waits_for_its_model(monkeypatch):
    rig = Rig(thermal_s=1.0, link=LoopbackLink(epoch="unix"))
    index = np.arange(4000)
    warmth = 25.0 + np.sin(2.0 * np.pi * index / 5000.0)
    values = 1e-3 * np.random.default_rng(1).standard_normal((4000, 6)) + 2e-3 * (warmth - 25.0)[:, None]
    rig.station._push(make_block(index * 10_000_000, values, warmth, index))  # as fast as can be
    with monkeypatch.context() as slow:
        slow.setattr(device_worker, "MODEL_SELECTION_REPLAY_S", 0.0)  # a step each time, however fast the machine is
        rig.work(1000.0)
    assert rig.station.pipeline.thermal.is_selecting_model
    assert 12 <= len(rig.caught.thermals) <= 20
    assert not rig.station._can_take()
    for i in range(2000):
        rig.work(1000.0 + i)
    assert len(rig.caught.thermals) == 39
    assert rig.station._can_take()
    assert all(look.axes["gz"].one_step is not None for _, look in rig.caught.thermals[20:])


def test_at_the_end_nothing_waits_for_a_model():
    rig = Rig(thermal_s=1.0, link=LoopbackLink(epoch="unix"))
    rig.bring(4000)
    rig.work(1000.0, drain=True)
    assert sum(map(len, rig.caught.blocks)) == 4000
    assert rig.caught.estimates[-1][1].samples == 4000
    assert len(rig.caught.thermals) == 40


def test_where_it_is_off_nothing_is_held_against_temperature():
    rig = Rig(thermal_s=None)
    follow_temperature(rig, 5.0)
    assert (rig.station.pipeline.thermal, rig.caught.thermals) == (None, [])
    assert rig.station.pipeline.signal_monitor.take_samples_with_motion_masked() == []


def test_without_a_model_there_is_no_gap():
    rig = Rig()
    rig.bring(2000)
    rig.work(1000.0, drain=True)
    assert (len(rig.caught.estimates), rig.caught.gaps) == (1, [])


def test_a_model_that_is_none_is_said_at_once(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("[gz.angle_random_wolk]\nN = 1e-4\n")
    with pytest.raises(ConfigError, match=r"mine\.toml: .*angle_random_walk"):
        Rig(model=path)


def test_the_samples_of_the_window_and_their_temperature():
    rig = Rig(window_s=5.0)
    assert rig.station.copy_window_and_temperature() is None
    for i in range(14):
        rig.bring(50, lost=3 if i == 12 else 0)
        rig.work(1000.0 + 0.1 * i)
    held, temperature_c = rig.station.copy_window_and_temperature()
    values = held.restore_samples()
    sent = np.concatenate([samples.values for samples in rig.caught.blocks] + [np.empty((0, 6))])
    assert (len(held), temperature_c.shape) == (500, (500,))
    assert np.isnan(values[397:400]).all()
    assert np.isnan(temperature_c[397:400]).all()
    np.testing.assert_allclose(values[400:], sent[-100:], rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(temperature_c[400:], 20.0 + 1e-3 * np.arange(603, 703), rtol=1e-6)


def test_every_sample_comes_out_without_drift_too_and_models_are_identified_beside_the_loop():
    rig = Rig()
    threads = set()
    for i in range(75):
        rig.bring(100)
        rig.work(1000.0 + i)
        if work := rig.station.pipeline.arma_worker._work:  # until its result is taken over
            threads.add(work.thread)
    assert {thread.name for thread in threads} == {"drift of bench"}
    for thread in threads:
        thread.join(PATIENCE_S)
    rig.bring(100)
    rig.work(1100.0, drain=True)
    measured, rates = concatenate_blocks(rig.caught.blocks), concatenate_blocks(rig.caught.rates)
    np.testing.assert_array_equal(rates.t_ns, measured.t_ns)
    np.testing.assert_array_equal(rates.values[:, 3:], measured.values[:, 3:])
    assert rates.values[2000:, :3].std() < 0.3 * measured.values[2000:, :3].std()
    ends = [look.t_ns for _, look in rig.caught.drifts]
    assert ends == [k * 1_000_000_000 + 990_000_000 for k in range(len(ends))]
    assert len(ends) == 75
    assert rig.station.pipeline.compensation.compensator.models[0] is not None


def test_a_recording_waits_for_its_models(tmp_path):
    np.savez(tmp_path / "a.npz", fs=100.0, gz=np.zeros(10))
    rig = Rig(link=replay_link.build(replay_link.Settings(path=str(tmp_path / "a.npz"))))
    for i in range(65):
        rig.bring(100)
        rig.work(1000.0 + i)
    assert all(model is not None for model in rig.station.pipeline.compensation.compensator.models)


def test_nothing_is_compensated_where_it_is_not_wanted_or_no_gyro_is_measured():
    off = Rig(compensate=False)
    off.bring(500)
    off.work(1000.0, drain=True)
    blind = Rig()
    values = np.full((500, 6), np.nan)
    values[:, 3:] = 1.0
    blind.station._push(make_block(np.arange(500) * 10_000_000, values))
    blind.work(1000.0, drain=True)
    for rig in (off, blind):
        assert rig.caught.blocks
        assert not rig.caught.rates


def test_a_step_of_the_bias_is_an_event_of_its_time():
    rig = Rig(thermal_s=None)
    for i in range(60):
        rig.bring(1000)
        if i >= 20:
            rig.station.ring.take_samples()
            at = np.arange(rig.sent - 1000, rig.sent)
            values = 1e-3 * np.random.default_rng(i).standard_normal((1000, 6))
            values[:, 1] += 0.02
            rig.station._push(make_block(at * 10_000_000, values, np.full(1000, 20.0), at))
        rig.work(1000.0 + i, drain=i == 59)
        rig.finish_models()
    told = [
        event
        for _, event in rig.caught.events
        if event.kind == "drift_unexplained" and "step of the bias" in event.text
    ]
    assert [event.axis for event in told] == ["gy"]
    assert told[0].values["bias"]["size"] == pytest.approx(0.02, rel=0.05)
    assert 390 < told[0].t_ns / 1e9 < 510  # as long as the level before had been confirmed, 5 min at most


@pytest.mark.parametrize(("step_s", "text", "status"), [
    (-3600, "the host clock was set back by 3600 s; sample times follow by 1.8 s", "ahead of the host clock"),
    (86_400, "the host clock was set forward by 86400 s; sample times follow by 1.8 s", "behind the host clock"),
])  # fmt: skip
def test_a_host_clock_that_is_set_is_told_once_and_stands_in_the_status(monkeypatch, step_s, text, status):
    rig = Rig()
    rig.station.driver.state, rig.station.driver.text = "running", ""
    host = time.time_ns
    assert rig.station.slew_and_publish_status({}, 0).text == ""
    monkeypatch.setattr(time, "time_ns", lambda: host() + step_s * 1_000_000_000)
    texts = [rig.station.slew_and_publish_status({}, 0).text for _ in range(3)]
    assert all(status in one for one in texts), texts
    (event,) = [event for _, event in rig.caught.events]
    assert event.kind == "clock_jumped"
    assert event.text.startswith(text)
    monkeypatch.undo()
    assert rig.station.slew_and_publish_status({}, 0).text == ""


def test_a_recording_has_its_own_times_whatever_the_host_does(monkeypatch, tmp_path):
    path = tmp_path / "x.csv"
    path.write_text("t,gx\n0.0,1.0\n0.01,2.0\n")
    rig = Rig(link=replay_link.build(replay_link.Settings(path=str(path))))
    rig.station.driver.state, rig.station.driver.text = "running", ""
    host = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: host() + 10**13)
    assert rig.station.slew_and_publish_status({}, 0).text == ""
    assert rig.caught.events == []


def replayed(tmp_path, **more):
    path = tmp_path / "x.csv"
    path.write_text("t,gx\n0.0,1.0\n0.01,2.0\n")
    return Rig(link=replay_link.build(replay_link.Settings(path=str(path))), **more)


def test_before_its_first_sample_a_recording_has_no_time(tmp_path):
    rig = replayed(tmp_path)
    rig.station.slew_and_publish_status({}, 0)
    rig.station.driver.state = "running"
    rig.station.slew_and_publish_status({}, 0)
    rig.station.publish_event("recording_stopped", "no room")
    rig.work(1000.0)
    assert rig.caught.health_times == [None, None]
    assert rig.caught.events == []
    rig.bring(10)
    rig.work(1001.0)
    rig.station.slew_and_publish_status({}, 0)
    assert rig.caught.health_times[2:] == [0.09]
    assert [(at_s, event.text) for at_s, event in rig.caught.events] == [(0.09, "no room")]
    rig.station.driver.state = "lost"
    assert rig.station.timeline.now_unix_s() == 0.09  # a recording's time does not go on by itself


def test_while_samples_wait_in_the_ring_the_first_has_the_time(tmp_path):
    rig = replayed(tmp_path, ready=KernelReadiness())
    rig.station.driver.first_t_ns = 10_000_000  # as the reader sees it
    rig.bring(10)
    rig.station.driver.state = "running"
    rig.work(1000.0)
    assert rig.caught.blocks == []
    assert rig.station.timeline.now_unix_s() == 0.01


def test_the_time_of_a_device_with_its_own_clock_goes_on_while_it_is_lost(monkeypatch):
    rig = Rig(decoder=samples.build(samples.Settings()))
    assert rig.station.driver.times_are_unix
    assert rig.station.timeline.now_unix_s() is None
    rig.station.driver.state = "running"
    rig.bring(11)
    rig.work(1000.0)
    assert rig.station.timeline.now_unix_s() == 0.1
    rig.station.driver.state = "lost"
    host = time.monotonic_ns
    monkeypatch.setattr(time, "monotonic_ns", lambda: host() + 3_600 * 10**9)
    assert rig.station.timeline.now_unix_s() == pytest.approx(3600.1, abs=60.0)


def test_before_its_first_sample_a_sensor_has_the_host_s_time():
    rig, begun_s = Rig(), time.time()
    rig.station.slew_and_publish_status({}, 0)
    rig.station.publish_event("recording_stopped", "no room")
    (health_s,), ((event_s, _),) = rig.caught.health_times, rig.caught.events
    assert begun_s - 1.0 <= health_s <= event_s <= time.time() + 1.0


def test_slow_statistics_of_a_rebuilt_window_have_its_time(tmp_path):
    rig = replayed(tmp_path)
    index = np.arange(400)
    values = 1e-3 * np.random.default_rng(1).standard_normal((400, 6))
    rig.station.pipeline.replay_samples(make_block(10**9 + index * 10_000_000, values), RATE)
    for i in range(10_000):
        rig.work(1000.0 + 100.0 * i)
        if rig.caught.totals:
            break
    assert rig.caught.total_times[:1] == [4.99]
