"""Tests that an error in one device, in one output or in one recorded state does not affect the other devices."""

import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import pytest

from drivers.data_types import make_block
from drivers.driver import AxisMap
from drivers.recordings import segment_file
from drivers.recordings.segment_file import DaemonState, SegmentFileWriter
from monitor.daemon.device import device_worker
from monitor.daemon.service import Service
from monitor.daemon.storage.recorder import segment_metadata
from tests.support.waiting import wait_for
from tests.system.rig import RecordingOutput, run_service

RATE_HZ = 100.0
ROWS = 2000
HEAD = '[zenoh]\nmode = "none"\n[viewer]\nmode = "none"\n'
DEVICE = '[[device]]\nname = "{name}"\nwindow = "1min"\npublish = "10 Hz"\ndriver = {{ link = "virtual" }}\n'
STATE = msgspec.to_builtins(DaemonState(RATE_HZ, (None,) * 6, 1.0, (1e-12,) * 30, (True,) * 30))


def record_device(folder: Path, name: str, seed: int, state: bytes, lost: int = 0) -> Path:
    """Write a segment of ROWS rows that ends now, whose last batch has this state."""
    (folder / name).mkdir(parents=True)
    begin_ns = time.time_ns() - round((ROWS + 1) / RATE_HZ * 1e9)
    path = folder / name / segment_file.format_segment_name(1, begin_ns / 1e9)
    writer = SegmentFileWriter(path, segment_metadata(name, AxisMap()))
    values = np.random.default_rng(seed).normal(0.0, 1e-3, (ROWS, 6))
    t_ns = begin_ns + (np.arange(ROWS) * 1e9 / RATE_HZ).astype(np.int64)
    for rows, meta in ((slice(0, -100), json.dumps(STATE).encode()), (slice(-100, None), state)):
        ticks = np.arange(ROWS)[rows]
        block = make_block(t_ns[rows].copy(), values[rows].copy(), ticks=ticks, lost=lost if rows.start else 0)
        writer._write_batch(segment_file._sample_batch(writer._pa, writer._schema, [block]), {b"state": meta})
    writer.close()
    return path


def with_state(**changed: object) -> Callable[[Path, str, int], None]:
    """Return a function that records a device whose last state has these damaged values."""
    return lambda folder, name, seed: _record_state(folder, name, seed, json.dumps({**STATE, **changed}).encode())


def _record_state(folder: Path, name: str, seed: int, state: bytes, lost: int = 0) -> None:
    record_device(folder, name, seed, state, lost)


def with_bytes(change: Callable[[bytes], bytes]) -> Callable[[Path, str, int], None]:
    """Return a function that records a device and changes the bytes of the file."""

    def record(folder: Path, name: str, seed: int) -> None:
        path = record_device(folder, name, seed, json.dumps(STATE).encode())
        path.write_bytes(change(path.read_bytes()))

    return record


def replaced(values: tuple[object, ...], at: int, value: object) -> list[object]:
    return [*values[:at], value, *values[at + 1 :]]


FUTURE_S = 4.0e9
MAGICS = (b"PK\3\4", b"\0" * 8, b"ARROW1")
DAMAGES: dict[str, list[Callable[[Path, str, int], None]]] = {
    "truncated": [with_bytes(lambda data, keep=keep: data[: int(keep * len(data))]) for keep in (0.02, 0.1, 0.4)],
    "wrong magic": [with_bytes(lambda data, head=head: head + data[len(head) :]) for head in MAGICS],
    "empty": [with_bytes(lambda data, left=left: data[:left]) for left in (0, 1, 4)],
    "NaN": [
        partial(_record_state, state=json.dumps({**STATE, key: value}).encode())
        for key, value in (("rate", float("nan")), ("tick_step", float("nan")), ("since", [float("nan")] * 6))
    ],
    "1e308": [with_state(since=replaced((None,) * 6, axis, 1e308)) for axis in (0, 2, 5)],
    "negative counts": [
        partial(_record_state, state=json.dumps(STATE).encode(), lost=-lost) for lost in (1, 1000, 1 << 40)
    ],
    "future time": [with_state(since=replaced((None,) * 6, axis, FUTURE_S)) for axis in (1, 3, 4)],
    "wrong shape": [with_state(theta=[1.0] * 29), with_state(since=[None] * 5), with_state(entered=[True] * 6)],
    "other rate": [with_state(rate=rate) for rate in (1e6, 3.0, 1e-3)],
    "wrong type": [with_state(rate="fast"), with_state(theta={"gx": 1.0}), with_state(entered=[2] * 30)],
}  # fmt: skip


@pytest.mark.parametrize("kind", DAMAGES)
def test_damaged_states_do_not_affect_the_other_device(tmp_path: Path, kind: str) -> None:
    names = ["a", "b", "c", "d"]
    sound = names.pop(len(kind) % 4)
    damages = dict(zip(names, DAMAGES[kind], strict=True))
    for name, damage in damages.items():
        damage(tmp_path / "store", name, ord(name))
    record_device(tmp_path / "store", sound, ord(sound), json.dumps(STATE).encode())
    devices = "".join(DEVICE.format(name=name) for name in "abcd")
    text = HEAD + f'[storage]\nfolder = "{tmp_path / "store"}"\n' + devices
    output = RecordingOutput()

    def texts(name: str) -> list[str]:
        kinds = ("window_rebuilt", "estimation_restarted")
        return [event.text for device, event in output.events if device == name and event.kind in kinds]

    with run_service(tmp_path, text, output):
        wait_for(lambda: set(output.estimates) == set("abcd"), lambda: (set(output.estimates), output.events))
        wait_for(lambda: all(map(texts, "abcd")), lambda: output.events)
        for name, estimate in output.estimates.items():
            assert np.isfinite(estimate.coefficients.value[1]).any() or estimate.curve.n < ROWS, name
        assert output.estimates[sound].curve.n >= ROWS
        assert "rebuilt from the recording" in texts(sound)[0]
        for name in damages:
            (said,) = texts(name)
            assert "starts empty" in said or "rebuilt from the recording" in said


# --- exceptions in one stage of one device

STAGES = ("decode", "time", "push", "detect", "estimate", "thermal", "compensate", "fit", "publish", "status", "output")


class Fault(Exception):
    """Unexpected exception of one stage."""


class FaultyOutput(RecordingOutput):
    """Output that fails for the device "bad" while ``broken`` is True."""

    broken = False

    def publish_samples(self, device, received, samples, offset_ns) -> None:
        if self.broken and device == "bad":
            raise Fault("output")
        super().publish_samples(device, received, samples, offset_ns)


def break_stage(patch: pytest.MonkeyPatch, service: Service, stage: str, output: FaultyOutput) -> None:
    """Make one stage of the device "bad" raise an exception until ``patch`` is undone."""
    worker = next(one for one in service.workers if one.name == "bad")
    broken: dict[str, tuple[Callable[[], object], str]] = {
        "decode": (lambda: worker.driver.decoder, "feed"),
        "time": (lambda: worker.clock, "assign_times"),
        "push": (lambda: worker.ring, "push_samples"),
        "detect": (lambda: worker.pipeline.motion_and_change_monitor, "process_samples"),
        "estimate": (lambda: worker.pipeline.estimator, "add_samples"),
        "thermal": (lambda: worker.pipeline.thermal, "process_block"),
        "compensate": (lambda: worker.pipeline.compensation, "compensate_block"),
        "fit": (lambda: worker.pipeline.estimator, "get_estimate"),
        "publish": (lambda: worker.publisher, "publish_thermal_intervals"),
        "status": (lambda: worker.status, "build_health"),
    }
    if stage == "output":
        patch.setattr(output, "broken", True)
        return
    find, method = broken[stage]
    original = getattr(type(find()), method)

    def fail_for_one_device(part: object, *arguments: object, **options: object) -> object:
        if part is find():  # the part is replaced when the estimation is started again
            raise Fault(stage)
        return original(part, *arguments, **options)

    patch.setattr(type(find()), method, fail_for_one_device)


@pytest.mark.parametrize("stage", STAGES)
def test_exception_in_one_stage_of_one_device_does_not_affect_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stage: str
) -> None:
    monkeypatch.setattr("drivers.driver.MAX_RETRY_PAUSE_S", 0.2)
    monkeypatch.setattr(device_worker, "MIN_RESTART_PAUSE_S", 0.1)
    text = HEAD + "".join(DEVICE.format(name=name) for name in ("bad", "good"))
    output, second = FaultyOutput(), RecordingOutput()
    with (
        run_service(tmp_path, text, output, lambda service: service.outputs.append(second)) as run,
        monkeypatch.context() as patch,
    ):
        wait_for(lambda: len(output.estimates) == 2 and len(output.healths) == 2, "estimates of both devices")
        wait_for(lambda: all(one.pipeline.compensation is not None for one in run.service.workers), "all stages")
        break_stage(patch, run.service, stage, output)
        shown = (lambda: output.healths["bad"].outputs.get("other", "")) if stage == "output" else (
            lambda: output.healths["bad"].text)  # fmt: skip
        wait_for(lambda: f"Fault: {stage}" in shown() or f"Fault('{stage}')" in shown(), lambda: output.healths["bad"])
        before = output.healths["good"].received
        good = output.estimates["good"].samples
        wait_for(lambda: output.estimates["good"].samples > good + 100, "more estimates of the other device")
        wait_for(lambda: output.healths["good"].received > before, "the status of the other device")
        assert output.healths["good"].text == ""
        assert output.healths["good"].state == "running"
        received = {name: len(blocks) for name, blocks in second.blocks.items()}
        patch.undo()
        wait_for(lambda: len(second.blocks["bad"]) > received["bad"] + 3, "more samples of the device")
        wait_for(lambda: "Fault" not in output.healths["bad"].text, lambda: output.healths["bad"])
        estimate = output.estimates["bad"]
        wait_for(lambda: output.estimates["bad"] is not estimate, "a new estimate of the device")
        restarted = [event for device, event in output.events if event.kind == "estimation_restarted"]
        reader_or_output = ("decode", "time", "push", "output")
        assert {event.text for event in restarted} == (
            set() if stage in reader_or_output else {f"unexpected Fault: {stage}; the window starts empty"}
        )
