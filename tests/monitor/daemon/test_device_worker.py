"""Tests of the worker of one device: publication, rate checks, thermal models, compensation and times."""

import re
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from drivers.data_types import AXES, Event, concatenate_blocks, make_block
from drivers.decoders import dbc
from drivers.decoders.binary_frames import vectornav_binary
from drivers.decoders.messages import samples
from drivers.decoders.text_lines import text
from drivers.errors import ConfigError
from drivers.host.wake_signal import WakeSignal
from drivers.links import replay_link
from monitor.daemon.device import device_worker
from monitor.daemon.device.device_worker import DeviceWorker
from monitor.daemon.kernels.kernel_readiness import KernelReadiness
from monitor.drift.compensation.live_compensation import MeasuredAndSubtractedDrift
from monitor.drift.thermal.live_thermal import ThermalIntervalResult
from monitor.estimation.detection.comparison_with_noise_model import ModelComparison
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients_with_intervals import Status
from monitor.noise.effects import AngleRandomWalk, BiasInstability, RateRandomWalk
from monitor.noise.model import NoiseModel
from monitor.publishing import exporters
from monitor.publishing.messages.results import CoefficientsMessage, TotalAndHadamardCurves
from monitor.settings import loading as settings
from monitor.settings.loading import BuiltLinkAndDecoder, Device
from tests.support.loopback_link import LoopbackLink
from tests.support.settings import read_settings
from tests.support.waiting import PATIENCE_S, wait_for

RATE = 100.0


class CollectingOutput:
    """An output that stores everything it receives."""

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


class WorkerHarness:
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
        restart=True,
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
            restart=restart,
        )
        self.wake = WakeSignal()
        self.ready = ready or KernelReadiness()
        if ready is None:
            self.ready.window.set()
            self.ready.fit.set()
            self.ready.all.set()
        self.output = CollectingOutput()
        self.worker = DeviceWorker(device, self.link, [self.output], self.wake, self.ready)
        self.sent = self.stamped = 0
        self.link.open()

    def push_samples(self, n, lost=0, scale=1.0):
        """Push samples as the reader would, with times of the host clock."""
        self.sent += lost
        index = np.arange(self.sent, self.sent + n)
        self.sent += n
        values = 1e-3 * scale * np.random.default_rng(self.sent).standard_normal((n, 6))
        samples = make_block(index * 10_000_000, values, 20.0 + 1e-3 * index, index, lost)
        self.worker.driver.counts.received += n
        self.worker._push(samples)

    def process(self, now_s, drain=False):
        self.worker.process_new_samples(now_s, drain)

    def wait_for_model_thread(self):
        """Wait for the thread that identifies drift models; samples arrive much faster here than from a sensor."""
        for thread in threading.enumerate():
            if thread.name == self.worker.pipeline.arma_worker._name:
                thread.join(PATIENCE_S)


def test_final_estimate_covers_all_samples_after_draining():
    harness = WorkerHarness(refit_s=10.0, publish_s=10.0)
    harness.process(1000.0)
    for i in range(30):
        harness.push_samples(50)
        harness.process(1000.0 + 0.1 * i)
    harness.push_samples(7)
    harness.process(1003.0, drain=True)
    assert sum(len(block) for block in harness.output.blocks) == 1507 == harness.output.counts[-1]
    assert np.array_equal(np.concatenate([block.t_ns for block in harness.output.blocks]), np.arange(1507) * 10_000_000)
    _, last = harness.output.estimates[-1]
    assert (last.samples, last.curve.n, last.t_ns) == (1507, 1507, 15_060_000_000)


def test_running_device_with_late_can_frames_reports_them():
    signals = {"gz": "AngularRateInformation.YawRate", "az": "AccelerationSensor.VerticalAcceleration"}
    settings = {"file": "j1939_imu", "signals": signals, "window": 0.005}
    decoder = dbc.build(read_settings(dbc.Settings, settings))
    harness = WorkerHarness(rate=50.0, decoder=decoder)
    sent = decoder.encode(make_block(np.arange(50) * 20_000_000, np.ones((50, 6))))
    for i, chunk in enumerate(sent):
        delay_ns = i % 2 * (8_000_000 if i // 2 == 30 else 1_000_000)
        harness.link.write(replace(chunk, t_ns=chunk.t_ns + delay_ns))
    harness.worker.driver.read_and_push_once()
    health = harness.worker.status.build_health({}, 0)
    assert health.state == "running"
    assert (health.received, health.bad, health.lost, health.late) == (49, 0, 1, 1)
    assert health.text == (
        "frames of one sample arrive 8 ms apart, more than window = 0.005 s: increase `window` in decoder_options"
    )


def test_estimates_and_samples_are_published_at_their_intervals():
    harness = WorkerHarness(refit_s=0.5, publish_s=2.0)
    for i in range(1000):
        harness.push_samples(1)
        harness.process(1000.0 + 0.01 * i)
    assert 4 <= len(harness.output.estimates) <= 6
    # Raw samples are published in short batches.
    assert 80 <= len(harness.output.blocks) <= 110
    assert sum(map(len, harness.output.blocks)) >= 985


def test_zero_intervals_publish_every_sample_and_block():
    harness = WorkerHarness(refit_s=0.0, publish_s=0.0)
    harness.push_samples(20)
    harness.process(1000.0)
    for i in range(30):
        harness.push_samples(1)
        harness.process(1000.001 + 0.0001 * i)
    assert len(harness.output.estimates) == 31
    assert [estimate.samples for _, estimate in harness.output.estimates] == list(range(20, 51))
    assert len(harness.output.blocks) == 31


def test_published_histories_contain_every_sample():
    harness = WorkerHarness(refit_s=0.0, publish_s=0.5)
    for i in range(200):
        harness.push_samples(5)
        harness.process(1000.0 + 0.05 * i)
    harness.process(1010.0, drain=True)
    assert 18 <= len(harness.output.estimates) <= 22
    t_ns = np.concatenate([estimate.history.t_ns for _, estimate in harness.output.estimates])
    assert np.array_equal(t_ns, np.arange(1000) * 10_000_000)


def test_fit_at_every_sample_waits_for_compiled_kernels():
    ready = KernelReadiness(interpretable_hz=0.0)
    ready.window.set()
    harness = WorkerHarness(refit_s=0.0, publish_s=0.0, ready=ready)
    harness.push_samples(300)
    harness.process(1000.0)
    assert (harness.output.blocks, harness.output.estimates) == ([], [])
    ready.fit.set()
    harness.process(1000.05)
    assert harness.output.estimates == []
    ready.all.set()
    harness.process(1000.1)
    assert harness.output.estimates[-1][1].history.t_ns.size == 300


def test_missed_publications_are_not_made_up_after_a_pause():
    harness = WorkerHarness(refit_s=0.1, publish_s=0.1)
    harness.push_samples(50)
    harness.process(1000.0)
    for i in range(20):
        harness.push_samples(1)
        harness.process(2000.0 + 0.001 * i)
    assert len(harness.output.estimates) == 2


def test_unchanged_estimate_is_not_published_again():
    harness = WorkerHarness(refit_s=0.0, publish_s=0.0)
    harness.push_samples(20)
    for i in range(5):
        harness.process(1000.0 + i)
    assert (len(harness.output.estimates), len(harness.output.blocks)) == (1, 1)


def test_samples_wait_for_an_unknown_rate_and_none_is_omitted():
    lines = text.Settings(columns=("gx", "gy", "gz", "ax", "ay", "az"))
    harness = WorkerHarness(rate=None, decoder=text.build(lines))
    harness.push_samples(300)
    harness.process(1000.0)
    assert harness.output.estimates == []
    assert harness.output.blocks == []
    for i in range(400):  # the clock learns the rate from the times assigned by the reader
        t_ns = np.array([10**12 + i * 10_000_000])
        harness.worker.clock.assign_times(make_block(t_ns, np.zeros((1, 6))))
    harness.push_samples(100)
    harness.process(1001.0)
    assert sum(map(len, harness.output.blocks)) == 400
    (_, found) = harness.output.estimates[-1]
    assert (found.samples, found.curve.n, found.rate_hz) == (400, 400, 100.0)


@pytest.mark.long
def test_improved_rate_estimate_is_published_with_the_curve():
    lines = text.Settings(columns=("gx", "gy", "gz", "ax", "ay", "az"))
    harness = WorkerHarness(rate=None, decoder=text.build(lines))
    t_ns = 10**12
    for _ in range(300):
        t_ns += 10_300_000
        harness.worker.clock.assign_times(make_block(np.array([t_ns]), np.zeros((1, 6))))
    harness.push_samples(500)
    harness.process(1000.0, drain=True)
    before = harness.output.estimates[-1][1]
    for _ in range(20_000):
        t_ns += 10_000_000
        harness.worker.clock.assign_times(make_block(np.array([t_ns]), np.zeros((1, 6))))
    harness.worker.slew_and_publish_status({}, 0)
    harness.push_samples(1)
    harness.process(1001.0, drain=True)
    after = harness.output.estimates[-1][1]
    assert before.rate_hz == pytest.approx(97.087, rel=1e-4)
    assert after.rate_hz == 100.0
    assert np.array_equal(after.curve.factors, before.curve.factors)
    assert after.curve.n == 501


def test_reset_empties_the_window():
    harness = WorkerHarness()
    harness.worker.empty_window()
    harness.push_samples(500)
    harness.process(1000.0, drain=True)
    harness.worker.empty_window()
    harness.push_samples(30)
    harness.process(1001.0, drain=True)
    assert harness.output.estimates[-1][1].curve.n == 30
    assert harness.output.estimates[-1][1].samples == 530


@pytest.mark.parametrize("restart", [True, False])
def test_status_names_axes_whose_window_mixes_old_and_new_noise(restart):
    harness = WorkerHarness(window_s=60.0, restart=restart)
    harness.worker.driver.state, harness.worker.driver.text = "running", ""
    texts = []
    for i in range(150):
        harness.push_samples(100, scale=4.0 if i >= 40 else 1.0)
        harness.process(1000.0 + i, drain=i == 149)
        texts.append(harness.worker.status.build_health({}, 0).text)
    mixed = "the noise of gx, gy, gz, ax, ay, az changed within the window, which is not restarted (`restart = false`)"
    assert (mixed in texts) is not restart
    assert not any("changed" in text for text in texts[:40] + texts[105:])


def test_lost_samples_occupy_the_window_and_a_long_loss_empties_it():
    harness = WorkerHarness(window_s=5.0)
    harness.push_samples(300)
    harness.push_samples(50, lost=20)
    harness.process(1000.0, drain=True)
    assert harness.output.estimates[-1][1].curve.n == 370
    harness.push_samples(40, lost=10_000)
    harness.process(1001.0, drain=True)
    assert harness.output.estimates[-1][1].curve.n == 40


def test_status_states_the_missing_samples_of_the_window():
    harness = WorkerHarness()
    harness.push_samples(900)
    harness.push_samples(1000, lost=100)
    harness.process(1.0)
    loss = harness.worker.status.build_health({}, 0).loss
    assert loss.share == 0.05
    assert loss.wider["N"] > 0.02


def test_random_loss_hardly_widens_the_intervals_and_the_status_states_the_loss():
    n, rng, rows = 30_000, np.random.default_rng(1), []
    sources = (AngleRandomWalk(N=1e-4), BiasInstability(B=2e-4), RateRandomWalk(K=1.5e-4))
    values = NoiseModel(dict.fromkeys(AXES, sources)).simulate(n, RATE, 1)
    lost = rng.random(n) < 0.05
    for present in (np.arange(n), np.flatnonzero(~lost)):
        harness, before = WorkerHarness(window_s=n / RATE, refit_s=1e3, publish_s=1e3, compensate=False), -1
        gaps = np.flatnonzero(np.diff(present) > 1) + 1
        for k, index in enumerate(np.split(present, np.union1d(gaps, np.arange(0, present.size, 500)))[1:]):
            samples = make_block(
                index * 10_000_000, values[index], np.full(index.size, 25.0), index, int(index[0]) - before - 1
            )
            before = int(index[-1])
            harness.worker.driver.counts.received += index.size
            harness.worker._push(samples)
            harness.process(1000.0 + k)
        harness.process(9000.0, drain=True)
        coefficients = harness.output.estimates[-1][1].coefficients
        rows.append((coefficients.status[1:4], (coefficients.hi - coefficients.lo)[1:4]))
    (status, width), (status_with_loss, width_with_loss) = rows
    assert (status == Status.ESTIMATED).all()
    assert (status_with_loss == Status.ESTIMATED).all()
    assert (np.median(width_with_loss / width, axis=1) <= 1.25).all()
    sentence = harness.worker.status.build_health({}, 0).loss.describe()
    assert re.fullmatch(r"(4\.9|5|5\.1) % of the samples are missing: intervals of .*N \d %.* wider", sentence)


def test_unusable_tau_is_reported_and_samples_are_still_published():
    harness = WorkerHarness(rate=1000.0, window_s=0.1, tau=(5.0,))
    harness.push_samples(300)
    harness.process(1000.0, drain=True)
    assert sum(map(len, harness.output.blocks)) == 300
    assert harness.output.estimates == []
    harness.worker.driver.state, harness.worker.driver.text = "running", ""
    assert "tau: none of [5.0] s" in harness.worker.status.build_health({}, 0).text


def test_latency_is_measured_from_the_oldest_unpublished_sample():
    harness = WorkerHarness(refit_s=10.0, publish_s=10.0)
    harness.push_samples(10)
    harness.process(1000.0)  # published at once
    harness.worker.status.build_health({}, 0)
    harness.push_samples(1)
    harness.process(1000.01)  # taken over, but the batch is not published yet
    time.sleep(0.05)
    harness.push_samples(1)
    harness.process(1000.2)
    health = harness.worker.status.build_health({}, 0)
    assert health.latency_p50_s >= 0.05
    assert harness.worker.status.build_health({}, 0).latency_p50_s is None


def test_ring_overflow_is_counted_and_reported_as_lost_samples():
    harness = WorkerHarness()
    capacity = harness.worker.ring.capacity
    harness.push_samples(capacity)
    harness.push_samples(100)
    harness.process(1000.0, drain=True)
    assert harness.worker.status.build_health({}, 0).overflowed == 100
    assert harness.output.blocks[0].lost == 100
    assert sum(map(len, harness.output.blocks)) == capacity


def test_replay_through_the_reader_thread_is_processed_to_the_end():
    harness, begun_s = WorkerHarness(), time.time()
    encoder = vectornav_binary.build(vectornav_binary.Settings())
    index = np.arange(400)
    block = make_block(index, np.random.default_rng(0).standard_normal((400, 6)), None, index * 10_000_000)
    for chunk in encoder.encode(block):
        harness.link.write(chunk.data)
    harness.link.end()
    harness.worker.start_reader_and_resume_recording()
    wait_for(lambda: harness.process(time.monotonic()) or harness.worker.replay_finished, "the end of the replay")
    harness.worker.stop_reader_thread()
    assert harness.worker.join_reader_thread(PATIENCE_S)
    harness.process(time.monotonic(), drain=True)
    assert sum(map(len, harness.output.blocks)) == 400
    assert harness.output.estimates[-1][1].samples == 400
    assert harness.worker.slew_and_publish_status({"zenoh": "ok"}, 7).received == 400
    assert (harness.output.healths[-1].state, harness.output.healths[-1].memory_bytes) == ("ended", 7)
    assert harness.wake.wait_and_clear(0.0)
    # The times are Unix times of samples stamped by the monotonic clock.
    assert begun_s - 5.0 <= harness.output.estimates[-1][0] <= time.time() + 5.0


def test_difference_from_the_configured_rate_is_reported():
    harness = WorkerHarness(rate=100.0)
    for i in range(400):
        harness.worker.clock.assign_times(make_block(np.array([10**12 + i * 20_000_000]), np.zeros((1, 6))))
    harness.worker.driver.state, harness.worker.driver.text = "running", ""
    message = (
        "measured rate 50 Hz differs from the configured 100 Hz; coefficients are withheld: correct `rate` or remove it"
    )
    assert harness.worker.status.build_health({}, 0).text == message
    harness.worker.driver.state, harness.worker.driver.text = "ended", "x.csv: the end of the file."
    assert harness.worker.status.build_health({}, 0).text == f"x.csv: the end of the file; {message}"


def assign_arrival_times(harness, n, rate_hz, rng):
    """Let the clock see samples that arrive with jitter of up to 20 ms."""
    at, harness.stamped = harness.stamped, harness.stamped + n
    arrived_s = (at + np.arange(n)) / rate_hz + rng.uniform(0.0, 0.02, n)
    for t_ns in np.maximum.accumulate(10**12 + np.rint(arrived_s * 1e9).astype(np.int64)):
        harness.worker.clock.assign_times(make_block(np.array([t_ns]), np.zeros((1, 6))))


def list_statuses(estimate):
    return set(estimate.coefficients.status.ravel().tolist())


def test_no_coefficients_are_estimated_if_the_device_contradicts_the_rate(tmp_path):
    lines = text.Settings(columns=("gx", "gy", "gz", "ax", "ay", "az"))
    harness, rng = (
        WorkerHarness(rate=200.0, decoder=text.build(lines), model=write_model_file(tmp_path)),
        np.random.default_rng(1),
    )
    for i in range(20):
        assign_arrival_times(harness, 50, 100.0, rng)
        harness.push_samples(50)
        harness.process(1000.0 + i)
    harness.worker.slew_and_publish_status({}, 0)
    harness.process(1100.0, drain=True)
    estimates = [estimate for _, estimate in harness.output.estimates]
    assert len(estimates) > 10
    assert set().union(*map(list_statuses, estimates)) == {Status.UNESTIMATED}
    last = estimates[-1]
    assert not np.isfinite(last.fitted).any()
    # The curve is available at averaging times of the measured rate.
    assert last.rate_hz == pytest.approx(100.0, rel=0.01)
    assert last.curve.tau_s == pytest.approx(last.curve.factors / last.rate_hz)
    assert np.isfinite(last.curve.avar[0]).all()
    assert [gap.axes for _, gap in harness.output.gaps] == [{}] * len(harness.output.gaps)
    assert len(harness.output.gaps) > 10
    assert harness.output.events == []


def test_almost_correct_configured_rate_is_used():
    lines = text.Settings(columns=("gx", "gy", "gz", "ax", "ay", "az"))
    harness, rng = WorkerHarness(rate=100.2, decoder=text.build(lines)), np.random.default_rng(1)
    for i in range(20):
        assign_arrival_times(harness, 50, 100.0, rng)
        harness.push_samples(50)
        harness.process(1000.0 + i)
    _, last = harness.output.estimates[-1]
    assert Status.ESTIMATED in list_statuses(last)
    assert last.rate_hz == 100.2
    harness.worker.driver.state, harness.worker.driver.text = "running", ""
    assert harness.worker.status.build_health({}, 0).text == ""


def test_measured_rate_replaces_a_configured_rate_within_oscillator_tolerance():
    lines = text.Settings(columns=("gx", "gy", "gz", "ax", "ay", "az"))
    harness, rng = WorkerHarness(rate=100.0, decoder=text.build(lines)), np.random.default_rng(1)
    for i in range(80):
        assign_arrival_times(harness, 50, 98.8, rng)
        harness.push_samples(50)
        harness.process(1000.0 + i)
        harness.worker.slew_and_publish_status({}, 0)
    _, last = harness.output.estimates[-1]
    assert Status.ESTIMATED in list_statuses(last)
    assert last.rate_hz == pytest.approx(98.8, rel=2e-3)


def test_coefficients_wait_until_the_rate_is_checked():
    lines = text.Settings(columns=("gx", "gy", "gz", "ax", "ay", "az"))
    harness, rng = WorkerHarness(rate=100.0, decoder=text.build(lines)), np.random.default_rng(1)
    assign_arrival_times(harness, 100, 100.0, rng)
    harness.push_samples(1000)
    harness.process(1000.0)
    assert list_statuses(harness.output.estimates[-1][1]) == {Status.UNESTIMATED}
    assign_arrival_times(harness, 200, 100.0, rng)
    harness.process(1001.0)  # there is no new sample, but the rate has been confirmed
    assert Status.ESTIMATED in list_statuses(harness.output.estimates[-1][1])


def test_captures_and_fast_simulations_skip_the_rate_check(tmp_path):
    capture = tmp_path / "x.bin"
    capture.write_bytes(b"")
    link = replay_link.build(replay_link.Settings(path=str(capture)))
    lines = text.build(text.Settings(columns=("gx", "gy", "gz", "ax", "ay", "az")))
    harness = WorkerHarness(rate=100.0, decoder=lines, link=link, ready=KernelReadiness())
    link.close()
    assign_arrival_times(harness, 600, 5000.0, np.random.default_rng(1))
    assert not harness.worker.clock.rate_check_pending
    assert harness.worker.clock.contradicting_rate_hz is None
    config = tmp_path / "config.toml"
    config.write_text(
        '[[device]]\nname = "d"\nrate = 100.0\n[device.driver]\nlink = "virtual"\ndecoder = "text"\nspeed = 30\n'
        '[device.driver.decoder_options]\ncolumns = ["gx", "gy", "gz"]\n'
    )
    (device,) = settings.load_config(config).devices
    worker = DeviceWorker(device, LoopbackLink(), [], WakeSignal(), KernelReadiness())
    for i in range(9000):
        worker.clock.assign_times(make_block(np.array([10**12 + i * 333_333]), np.zeros((1, 6))))
    assert not worker.clock.rate_check_pending
    assert worker.clock.contradicting_rate_hz is None


def test_replay_is_finished_only_when_its_samples_are_fitted():
    harness = WorkerHarness(ready=KernelReadiness(interpretable_hz=0.0))
    harness.push_samples(300)
    harness.process(1000.0)
    harness.worker.driver.state = "ended"
    assert not harness.worker.replay_finished
    harness.ready.window.set()
    harness.process(1001.0)
    assert harness.output.estimates[-1][1].coefficients.status.max() == 0  # there is only the curve
    assert not harness.worker.replay_finished
    harness.ready.fit.set()
    harness.process(1002.0)
    assert harness.output.estimates[-1][1].coefficients.status.max() > 0
    assert harness.worker.pipeline.motion_and_change_monitor is None
    harness.ready.all.set()
    assert harness.worker.replay_finished
    harness.push_samples(10)
    harness.process(1003.0)
    assert harness.worker.pipeline.motion_and_change_monitor is not None


def test_low_rate_device_is_estimated_by_interpreted_kernels():
    harness = WorkerHarness(rate=100.0, ready=KernelReadiness())
    harness.push_samples(300)
    harness.process(1000.0)
    assert harness.output.estimates[-1][1].coefficients.status.max() > 0
    assert harness.worker.pipeline.motion_and_change_monitor is not None
    harness.worker.driver.state, harness.worker.driver.text = "running", ""
    harness.ready.progress = "compiling 2 of 8: fit"
    assert harness.worker.status.build_health({}, 0).text == "compiling 2 of 8: fit; no sample is lost"


def test_interpreted_fits_run_once_per_second_and_compiled_fits_as_configured():
    ready = KernelReadiness()
    harness = WorkerHarness(rate=100.0, ready=ready)
    for i in range(40):
        harness.push_samples(10)
        harness.process(1000.0 + 0.1 * i)
    assert 4 <= len(harness.output.estimates) <= 5
    ready.fit.set()
    for i in range(40, 80):
        harness.push_samples(10)
        harness.process(1000.0 + 0.1 * i)
    assert len(harness.output.estimates) >= 34


@pytest.mark.parametrize("setting", [{"rate": 1000.0}, {"refit_s": 0.0}])
def test_high_rate_or_fit_at_every_sample_waits_for_compiled_kernels(setting):
    harness = WorkerHarness(ready=KernelReadiness(), **setting)
    harness.push_samples(300)
    harness.process(1000.0)
    assert harness.output.blocks == []


def test_devices_are_interpreted_up_to_a_total_rate():
    ready = KernelReadiness(interpretable_hz=250.0)
    harnesses = [WorkerHarness(rate=100.0, ready=ready) for _ in range(3)]
    for harness in harnesses:
        harness.push_samples(300)
        harness.process(1000.0)
        harness.process(1001.0)
    assert [len(harness.output.blocks) for harness in harnesses] == [1, 1, 0]


def test_samples_of_unknown_rate_are_published_without_estimates():
    lines = text.Settings(columns=("gx", "gy", "gz", "ax", "ay", "az"))
    harness = WorkerHarness(rate=None, decoder=text.build(lines))
    harness.push_samples(40_000)
    harness.process(1000.0)
    assert sum(map(len, harness.output.blocks)) == 40_000
    assert harness.output.estimates == []
    harness.worker.driver.state, harness.worker.driver.text = "running", ""
    assert (
        harness.worker.status.build_health({}, 0).text
        == "no estimate: the times of the samples do not show a rate; set `rate`"
    )


def write_model_file(folder):
    """Write the model of the white noise that ``WorkerHarness.push_samples`` generates."""
    path = folder / "mine.toml"
    path.write_text('["g*".angle_random_walk]\nN = 1e-4\n["a*".angle_random_walk]\nN = 1e-4\n')
    return path


def test_window_is_compared_with_the_model_in_force(tmp_path):
    harness = WorkerHarness(model=write_model_file(tmp_path))
    for i in range(30):
        harness.push_samples(50)
        harness.process(1000.0 + 0.5 * i)
    unix_s, comparison = harness.output.gaps[-1]
    assert (unix_s, comparison.samples) == (harness.output.estimates[-1][0], 1500)
    assert len(harness.output.gaps) == len(harness.output.estimates)
    assert harness.output.gaps[0][1].axes == {}  # there are too few samples
    assert comparison.agrees == dict.fromkeys(comparison.axes, True)
    assert len(comparison.axes) == 6
    assert not any(axis.gap > axis.threshold for axis in comparison.axes.values())
    assert harness.output.events == []


@pytest.mark.long
def test_disagreement_with_the_model_and_its_end_are_events(tmp_path):
    harness = WorkerHarness(window_s=20.0, model=write_model_file(tmp_path))
    first_reports = {}
    for i in range(240):
        harness.push_samples(50, scale=1.5 if 60 <= i < 100 else 1.0)
        harness.process(1000.0 + 0.5 * i)
        for _, event in harness.output.events:
            if event.kind == "model_disagrees":
                first_reports.setdefault((event.axis, event.values["model"]["agrees"]), i)
    assert {axis for axis, _ in first_reports} == {"gx", "gy", "gz", "ax", "ay", "az"}
    assert all(60 < i < 100 for (_, agrees), i in first_reports.items() if not agrees)
    assert sum(1 for _, agrees in first_reports if agrees) == 6
    assert all(i > 100 for (_, agrees), i in first_reports.items() if agrees)
    assert set(harness.output.gaps[-1][1].agrees.values()) == {True}


def push_samples_with_thermal_bias(harness, seconds, begin_s=0.0):
    """Push samples in blocks of 0.1 s whose bias follows a temperature that varies by 2 °C over 50 s."""
    for i in range(round(10 * seconds)):
        index = np.arange(harness.sent, harness.sent + 10)
        harness.sent += 10
        temperature_c = 25.0 + np.sin(2.0 * np.pi * index / 5000.0)
        values = (
            1e-3 * np.random.default_rng(harness.sent).standard_normal((10, 6)) + 2e-3 * (temperature_c - 25.0)[:, None]
        )
        harness.worker._push(make_block(index * 10_000_000, values, temperature_c, index))
        harness.process(begin_s + 0.1 * i)


@pytest.mark.long
def test_bias_is_predicted_from_temperature(monkeypatch):
    monkeypatch.setattr(device_worker, "MODEL_SELECTION_S", np.inf)  # the same models on any machine
    monkeypatch.setattr(device_worker, "MODEL_SELECTION_CPU_SHARE", np.inf)
    harness = WorkerHarness(thermal_s=1.0)
    push_samples_with_thermal_bias(harness, 30.0)
    push_samples_with_thermal_bias(harness, 3.0, 100.0)
    assert len(harness.output.thermals) >= 31
    unix_s, result = harness.output.thermals[-1]
    assert unix_s == harness.worker.timeline.to_unix_s(result.t_ns)
    assert set(result.axes) == {"gx", "gy", "gz", "ax", "ay", "az"}
    last = result.axes["gz"]
    assert last.one_step.bias == pytest.approx(last.bias, abs=5e-4)
    assert last.slope == pytest.approx(2e-3, rel=0.3)


def test_model_selection_does_not_block_processing(monkeypatch):
    monkeypatch.setattr(device_worker, "MODEL_SELECTION_S", 0.0)  # one selection step per call on any machine
    harness = WorkerHarness(thermal_s=1.0)
    push_samples_with_thermal_bias(harness, 14.0)
    assert harness.worker.pipeline.thermal.is_selecting_model
    for i in range(50):
        harness.process(100.0 + i)
    assert harness.worker._can_take()  # samples of a sensor never wait


@pytest.mark.long
def test_replay_waits_for_model_selection(monkeypatch):
    harness = WorkerHarness(thermal_s=1.0, link=LoopbackLink(epoch="unix"))
    index = np.arange(4000)
    temperature_c = 25.0 + np.sin(2.0 * np.pi * index / 5000.0)
    values = 1e-3 * np.random.default_rng(1).standard_normal((4000, 6)) + 2e-3 * (temperature_c - 25.0)[:, None]
    harness.worker._push(make_block(index * 10_000_000, values, temperature_c, index))  # all samples at once
    with monkeypatch.context() as slow:
        slow.setattr(device_worker, "MODEL_SELECTION_REPLAY_S", 0.0)  # one selection step per call on any machine
        harness.process(1000.0)
    assert harness.worker.pipeline.thermal.is_selecting_model
    assert 12 <= len(harness.output.thermals) <= 20
    assert not harness.worker._can_take()
    for i in range(2000):
        harness.process(1000.0 + i)
    assert len(harness.output.thermals) == 39
    assert harness.worker._can_take()
    assert all(result.axes["gz"].one_step is not None for _, result in harness.output.thermals[20:])


def test_export_of_published_coefficients_names_the_axis_that_follows_its_temperature(monkeypatch):
    monkeypatch.setattr(device_worker, "MODEL_SELECTION_REPLAY_S", np.inf)  # the same models on any machine
    harness = WorkerHarness(thermal_s=1.0, link=LoopbackLink(epoch="unix"))
    n, rng = 4000, np.random.default_rng(1)
    temperature_c = 25.0 + np.sin(2.0 * np.pi * np.arange(n) / 1000.0)
    values = 1e-3 * rng.standard_normal((n, 6))
    values[:, 2] += 2e-3 * (temperature_c - 25.0)
    harness.worker._push(make_block(np.arange(n) * 10_000_000, values, temperature_c, np.arange(n)))
    for i in range(40):
        harness.process(1000.0 + i)
    unix_s, estimate = harness.output.estimates[-1]
    message = CoefficientsMessage.from_result("a", unix_s, n, estimate)
    remarks = exporters.from_analysis_json(message.encode()).remarks
    assert len(remarks) == 1, remarks
    assert remarks[0].startswith("WARNING: gz follows its temperature, which explains 9")


def test_draining_does_not_wait_for_model_selection():
    harness = WorkerHarness(thermal_s=1.0, link=LoopbackLink(epoch="unix"))
    harness.push_samples(4000)
    harness.process(1000.0, drain=True)
    assert sum(map(len, harness.output.blocks)) == 4000
    assert harness.output.estimates[-1][1].samples == 4000
    assert len(harness.output.thermals) == 40


def test_disabled_thermal_model_gives_no_predictions():
    harness = WorkerHarness(thermal_s=None)
    push_samples_with_thermal_bias(harness, 5.0)
    assert (harness.worker.pipeline.thermal, harness.output.thermals) == (None, [])
    assert harness.worker.pipeline.motion_and_change_monitor.take_samples_with_motion_masked() == []


def test_without_a_model_nothing_is_compared():
    harness = WorkerHarness()
    harness.push_samples(2000)
    harness.process(1000.0, drain=True)
    assert (len(harness.output.estimates), harness.output.gaps) == (1, [])


def test_invalid_model_is_refused_at_the_start(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("[gz.angle_random_wolk]\nN = 1e-4\n")
    with pytest.raises(ConfigError, match=r"mine\.toml: .*angle_random_walk"):
        WorkerHarness(model=path)


def test_window_copy_has_samples_and_temperature_in_place():
    harness = WorkerHarness(window_s=5.0)
    assert harness.worker.copy_window_and_temperature() is None
    for i in range(14):
        harness.push_samples(50, lost=3 if i == 12 else 0)
        harness.process(1000.0 + 0.1 * i)
    window, temperature_c = harness.worker.copy_window_and_temperature()
    values = window.restore_samples()
    sent = np.concatenate([samples.values for samples in harness.output.blocks] + [np.empty((0, 6))])
    assert (len(window), temperature_c.shape) == (500, (500,))
    assert np.isnan(values[397:400]).all()
    assert np.isnan(temperature_c[397:400]).all()
    np.testing.assert_allclose(values[400:], sent[-100:], rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(temperature_c[400:], 20.0 + 1e-3 * np.arange(603, 703), rtol=1e-6)


def test_drift_compensated_samples_are_published_and_models_are_identified_in_a_thread():
    harness = WorkerHarness()
    threads = set()
    for i in range(75):
        harness.push_samples(100)
        harness.process(1000.0 + i)
        if identification := harness.worker.pipeline.arma_worker._work:  # until its result is used
            threads.add(identification.thread)
    assert {thread.name for thread in threads} == {"drift of bench"}
    for thread in threads:
        thread.join(PATIENCE_S)
    harness.push_samples(100)
    harness.process(1100.0, drain=True)
    measured, rates = concatenate_blocks(harness.output.blocks), concatenate_blocks(harness.output.rates)
    np.testing.assert_array_equal(rates.t_ns, measured.t_ns)
    np.testing.assert_array_equal(rates.values[:, 3:], measured.values[:, 3:])
    assert rates.values[2000:, :3].std() < 0.3 * measured.values[2000:, :3].std()
    ends = [update.t_ns for _, update in harness.output.drifts]
    assert ends == [k * 1_000_000_000 + 990_000_000 for k in range(len(ends))]
    assert len(ends) == 75
    assert harness.worker.pipeline.compensation.compensator.models[0] is not None


def test_replay_waits_for_its_drift_models(tmp_path):
    np.savez(tmp_path / "a.npz", fs=100.0, gz=np.zeros(10))
    harness = WorkerHarness(link=replay_link.build(replay_link.Settings(path=str(tmp_path / "a.npz"))))
    for i in range(65):
        harness.push_samples(100)
        harness.process(1000.0 + i)
    assert all(model is not None for model in harness.worker.pipeline.compensation.compensator.models)


def test_compensation_needs_the_setting_and_a_gyroscope():
    disabled = WorkerHarness(compensate=False)
    disabled.push_samples(500)
    disabled.process(1000.0, drain=True)
    without_gyro = WorkerHarness()
    values = np.full((500, 6), np.nan)
    values[:, 3:] = 1.0
    without_gyro.worker._push(make_block(np.arange(500) * 10_000_000, values))
    without_gyro.process(1000.0, drain=True)
    for harness in (disabled, without_gyro):
        assert harness.output.blocks
        assert not harness.output.rates


def test_step_of_the_bias_is_reported_as_an_event():
    harness = WorkerHarness(thermal_s=None)
    for i in range(60):
        harness.push_samples(1000)
        if i >= 20:
            harness.worker.ring.take_samples()
            at = np.arange(harness.sent - 1000, harness.sent)
            values = 1e-3 * np.random.default_rng(i).standard_normal((1000, 6))
            values[:, 1] += 0.02
            harness.worker._push(make_block(at * 10_000_000, values, np.full(1000, 20.0), at))
        harness.process(1000.0 + i, drain=i == 59)
        harness.wait_for_model_thread()
    steps = [
        event
        for _, event in harness.output.events
        if event.kind == "drift_unexplained" and "step of the bias" in event.text
    ]
    assert [event.axis for event in steps] == ["gy"]
    assert steps[0].values["bias"]["size"] == pytest.approx(0.02, rel=0.05)
    assert 390 < steps[0].t_ns / 1e9 < 510  # a step is confirmed for as long as the previous level, at most 5 min


@pytest.mark.parametrize(("step_s", "text", "status"), [
    (-3600, "the host clock was set back by 3600 s; sample times follow by 1.8 s", "ahead of the host clock"),
    (86_400, "the host clock was set forward by 86400 s; sample times follow by 1.8 s", "behind the host clock"),
])  # fmt: skip
def test_host_clock_change_is_reported_once_and_shown_in_the_status(monkeypatch, step_s, text, status):
    harness = WorkerHarness()
    harness.worker.driver.state, harness.worker.driver.text = "running", ""
    host = time.time_ns
    assert harness.worker.slew_and_publish_status({}, 0).text == ""
    monkeypatch.setattr(time, "time_ns", lambda: host() + step_s * 1_000_000_000)
    texts = [harness.worker.slew_and_publish_status({}, 0).text for _ in range(3)]
    assert all(status in text for text in texts), texts
    (event,) = [event for _, event in harness.output.events]
    assert event.kind == "clock_jumped"
    assert event.text.startswith(text)
    monkeypatch.undo()
    assert harness.worker.slew_and_publish_status({}, 0).text == ""


def test_host_clock_change_does_not_affect_a_recording(monkeypatch, tmp_path):
    path = tmp_path / "x.csv"
    path.write_text("t,gx\n0.0,1.0\n0.01,2.0\n")
    harness = WorkerHarness(link=replay_link.build(replay_link.Settings(path=str(path))))
    harness.worker.driver.state, harness.worker.driver.text = "running", ""
    host = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: host() + 10**13)
    assert harness.worker.slew_and_publish_status({}, 0).text == ""
    assert harness.output.events == []


def replay_two_samples(tmp_path, **more):
    path = tmp_path / "x.csv"
    path.write_text("t,gx\n0.0,1.0\n0.01,2.0\n")
    return WorkerHarness(link=replay_link.build(replay_link.Settings(path=str(path))), **more)


def test_recording_has_no_time_before_its_first_sample(tmp_path):
    harness = replay_two_samples(tmp_path)
    harness.worker.slew_and_publish_status({}, 0)
    harness.worker.driver.state, harness.worker.driver.text = "running", ""
    harness.worker.slew_and_publish_status({}, 0)
    harness.worker.publish_event("recording_stopped", "no room")
    harness.process(1000.0)
    assert harness.output.health_times == [None, None]
    assert harness.output.events == []
    harness.push_samples(10)
    harness.process(1001.0)
    harness.worker.slew_and_publish_status({}, 0)
    assert harness.output.health_times[2:] == [0.09]
    assert [(at_s, event.text) for at_s, event in harness.output.events] == [(0.09, "no room")]
    harness.worker.driver.state = "lost"
    assert harness.worker.timeline.now_unix_s() == 0.09  # the time of a recording does not advance by itself


def test_first_sample_in_the_ring_gives_the_time(tmp_path):
    harness = replay_two_samples(tmp_path, ready=KernelReadiness())
    harness.worker.driver.first_t_ns = 10_000_000  # as the reader sets it
    harness.push_samples(10)
    harness.worker.driver.state, harness.worker.driver.text = "running", ""
    harness.process(1000.0)
    assert harness.output.blocks == []
    assert harness.worker.timeline.now_unix_s() == 0.01


def test_time_of_a_lost_device_with_its_own_clock_advances(monkeypatch):
    harness = WorkerHarness(decoder=samples.build(samples.Settings()))
    assert harness.worker.driver.times_are_unix
    assert harness.worker.timeline.now_unix_s() is None
    harness.worker.driver.state, harness.worker.driver.text = "running", ""
    harness.push_samples(11)
    harness.process(1000.0)
    assert harness.worker.timeline.now_unix_s() == 0.1
    harness.worker.driver.state = "lost"
    host = time.monotonic_ns
    monkeypatch.setattr(time, "monotonic_ns", lambda: host() + 3_600 * 10**9)
    assert harness.worker.timeline.now_unix_s() == pytest.approx(3600.1, abs=60.0)


def test_sensor_has_the_host_time_before_its_first_sample():
    harness, begun_s = WorkerHarness(), time.time()
    harness.worker.slew_and_publish_status({}, 0)
    harness.worker.publish_event("recording_stopped", "no room")
    (health_s,), ((event_s, _),) = harness.output.health_times, harness.output.events
    assert begun_s - 1.0 <= health_s <= event_s <= time.time() + 1.0


def test_slow_statistics_of_a_rebuilt_window_have_the_time_of_the_window(tmp_path):
    harness = replay_two_samples(tmp_path)
    index = np.arange(400)
    values = 1e-3 * np.random.default_rng(1).standard_normal((400, 6))
    harness.worker.pipeline.replay_samples(make_block(10**9 + index * 10_000_000, values), RATE)
    for i in range(10_000):
        harness.process(1000.0 + 100.0 * i)
        if harness.output.totals:
            break
    assert harness.output.total_times[:1] == [4.99]


def test_changed_rate_starts_the_window_again_and_withholds_the_coefficients():
    harness = WorkerHarness()
    for i in range(20):
        harness.push_samples(50)
        harness.process(1000.0 + 0.1 * i)
    worker = harness.worker
    assert worker.pipeline.estimator.samples_in_window == 1000
    worker.driver._events.append(Event("rate_changed", worker.pipeline.newest_ns, "from 100 Hz to 50 Hz"))
    worker.clock._check.compare_with_measured_rate(50.0, 0.005)
    harness.process(1002.0)
    harness.push_samples(200)
    harness.process(1003.0)
    estimator = worker.pipeline.estimator
    assert (estimator.rate_hz, estimator.samples_in_window, estimator.window_s) == (50.0, 200, 20.0)
    assert [event.kind for _, event in harness.output.events] == ["rate_changed"]
    _, last = harness.output.estimates[-1]
    assert last.samples == 200
    assert (last.coefficients.status == Status.UNESTIMATED).all()
