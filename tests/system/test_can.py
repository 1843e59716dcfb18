"""Tests of recorded CAN traffic through the service, from a python-can log file and from an slcan adapter."""

import csv
import gzip
import itertools
import os
import threading
import time
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest

from drivers.data_types import AXES, Chunk, make_block
from drivers.decoders import dbc
from drivers.links.base import PolledLink
from drivers.units import DEGREE, G0
from tests.support.recordings import recordings
from tests.support.settings import read_settings
from tests.support.waiting import PATIENCE_S, wait_for
from tests.system.rig import PluggableTerminal, check_deviations_equal_batch, run_service, send_at_rate

OPTIONS = """
[device.driver.decoder_options]
file = "canmod_gps"
valid = "ImuData.ImuValid"
[device.driver.decoder_options.signals]
gx = "ImuData.AngularRateX"
gy = "ImuData.AngularRateY"
gz = "ImuData.AngularRateZ"
ax = "ImuData.AccelerationX"
ay = "ImuData.AccelerationY"
az = "ImuData.AccelerationZ"
[zenoh]
mode = "none"
[viewer]
mode = "none"
"""
HALF_LSB = np.repeat([0.125 * np.pi / 180.0, 0.0625], 3)


def read_frames(path: Path) -> list[can.Message]:
    with gzip.open(path, "rt") as file:
        return [
            can.Message(
                timestamp=float(row["t"]),
                arbitration_id=int(row["id_hex"], 16),
                is_extended_id=row["extended"] == "1",
                data=bytes.fromhex(row["data_hex"]),
            )
            for row in csv.DictReader(file)
        ]


def read_expected_values(path: Path) -> np.ndarray:
    with np.load(path) as npz:
        return np.column_stack([npz[axis].astype(float) for axis in AXES])


def select_imu_frames(messages: list[can.Message]) -> list[can.Message]:
    return [message for message in messages if message.arbitration_id == 9 and not message.is_extended_id]


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "kind"), [("can-boat/moored-5min", ".asc"), ("can-car/drive-a", ".blf"), ("can-car/drive-b", ".log")]
)
def test_log_file_gives_the_recorded_samples(tmp_path: Path, name: str, kind: str) -> None:
    folder = recordings()
    messages = read_frames(folder / f"{name}-frames.csv.gz")
    with can.Logger(str(tmp_path / f"drive{kind}")) as log:
        for message in messages:
            log.on_message_received(message)
    config = f"""[[device]]
name = "imu"
rate = 100.0
window = 700.0
[device.driver]
link = "replay"
path = "drive{kind}"
speed = "max"
decoder = "dbc"
"""
    with run_service(tmp_path, config + OPTIONS) as run:
        run.join()  # the service ends with the replay
        counts = run.worker("imu").driver.counts
    sent = select_imu_frames(messages)
    valid = np.array([frame.data[0] & 1 for frame in sent], bool)  # two frames of drive-b are marked as invalid
    assert (counts.received, counts.bad, counts.lost) == (valid.sum(), (~valid).sum(), 0)
    want = read_expected_values(folder / f"{name}.npz")
    assert len(want) == len(sent)
    assert (np.abs(run.output.values("imu") - want[valid]) <= HALF_LSB).all()


OXTS = {
    **{f"g{axis}": f"RateVehicle.AngRate{axis.upper()}" for axis in "xyz"},
    **{f"a{axis}": f"AccelVehicle.Accel{axis.upper()}" for axis in "xyz"},
}
CANOPEN = {
    **{f"g{axis}": f"Tpdo2.Rate{axis.upper()}" for axis in "xyz"},
    **{f"a{axis}": f"Tpdo1.Acceleration{axis.upper()}" for axis in "xyz"},
}
SAMPLES, CUT = 2000, (400, 1500)


@pytest.mark.parametrize(
    ("file", "signals", "gyro_step_deg_s", "accel_step_m_s2"),
    [
        ("oxts_rt", OXTS, 0.01, 0.01),
        ("sick_tmm61", CANOPEN, 7 / 800, G0 / 4096),
        ("dis_qg65d", CANOPEN, 0.01, 1e-3 * G0),
    ],
)
def test_received_and_bad_samples_of_shipped_databases_add_up(
    tmp_path: Path, file: str, signals: dict[str, str], gyro_step_deg_s: float, accel_step_m_s2: float
) -> None:
    steps = np.repeat([gyro_step_deg_s * DEGREE, accel_step_m_s2], 3)
    values = np.random.default_rng(6).normal(0.0, 20.0 * steps, (SAMPLES, 6))
    encoder = dbc.build(read_settings(dbc.Settings, {"file": file, "signals": signals}))
    chunks = encoder.encode(make_block(np.arange(1, SAMPLES + 1) * 10_000_000, values, None))
    frames = [list(group) for _, group in itertools.groupby(chunks, key=lambda chunk: chunk.t_ns)]
    with can.Logger(str(tmp_path / "drive.asc")) as log:
        for i, parts in enumerate(frames):
            for frame in parts:
                data = frame.data[:1] if i in CUT else frame.data
                log.on_message_received(can.Message(frame.t_ns * 1e-9, frame.address, is_extended_id=False, data=data))
    table = "".join(f'{axis} = "{signal}"\n' for axis, signal in signals.items())
    config = f"""[[device]]
name = "imu"
rate = 100.0
window = 60.0
restart = false
[device.driver]
link = "replay"
path = "drive.asc"
speed = "max"
decoder = "dbc"
[device.driver.decoder_options]
file = "{file}"
[device.driver.decoder_options.signals]
{table}[zenoh]
mode = "none"
[viewer]
mode = "none"
"""
    with run_service(tmp_path, config) as run:
        run.join()  # the service ends with the replay
        counts = run.worker("imu").driver.counts
    kept = np.setdiff1d(np.arange(SAMPLES), CUT)
    assert (counts.received, counts.bad, counts.lost) == (len(kept), len(CUT), 0)
    assert (np.abs(run.output.values("imu") - values[kept]) <= 0.501 * steps).all()
    check_deviations_equal_batch(run.output, "imu", kept)


class SlcanAdapter(threading.Thread):
    """Simulated serial CAN adapter, which waits for the command that opens the channel."""

    def __init__(self, terminal: PluggableTerminal) -> None:
        super().__init__(daemon=True)
        self._terminal = terminal
        self.opened = threading.Event()

    def run(self) -> None:
        while not self.opened.is_set():
            try:
                command = os.read(self._terminal.master, 256)
            except OSError:  # nobody has opened the other end yet
                time.sleep(0.05)
                continue
            if b"O" in command:
                self.opened.set()


def encode_slcan(message: can.Message) -> bytes:
    address = f"T{message.arbitration_id:08X}" if message.is_extended_id else f"t{message.arbitration_id:03X}"
    return f"{address}{len(message.data)}{message.data.hex().upper()}\r".encode()


def stamp_as_recorded(link: PolledLink, messages: list[can.Message]) -> None:
    """Give the frames of the IMU the times at which they were recorded.

    The frames have no counter, so a pause of a loaded machine would count as lost samples.
    """
    recorded = [message.timestamp for message in select_imu_frames(messages)]
    begun_ns = time.monotonic_ns() - round((recorded[-1] - recorded[0]) * 1e9)
    times_ns = iter([begun_ns + round((t_s - recorded[0]) * 1e9) for t_s in recorded])
    read = link.wait_for_chunks_or_timeout

    def read_and_stamp(timeout_s: float) -> list[Chunk] | None:
        chunks = read(timeout_s)
        link.empty_ns = 0  # the recorded times are earlier than the clock
        return None if chunks is None else [replace(chunk, t_ns=next(times_ns)) for chunk in chunks]

    link.wait_for_chunks_or_timeout = read_and_stamp  # type: ignore[method-assign]


@pytest.mark.data
@pytest.mark.parametrize("name", ["can-boat/moored-5min", "can-car/drive-a"])
def test_serial_can_adapter_gives_the_recorded_samples(tmp_path: Path, name: str) -> None:
    folder = recordings()
    messages = read_frames(folder / f"{name}-frames.csv.gz")
    messages = [message for message in messages if message.timestamp < messages[0].timestamp + 30.0]
    terminal = PluggableTerminal(tmp_path)
    adapter = SlcanAdapter(terminal)
    adapter.start()
    config = f"""[[device]]
name = "imu"
rate = 100.0
window = 400.0
[device.driver]
link = "can"
interface = "slcan"
channel = "{terminal.port}"
bitrate = 500000
decoder = "dbc"
"""
    with run_service(tmp_path, config + OPTIONS) as run:
        link = run.worker("imu").driver.link
        assert isinstance(link, PolledLink)
        stamp_as_recorded(link, messages)
        assert adapter.opened.wait(PATIENCE_S)
        send_at_rate(terminal.write, [encode_slcan(message) for message in messages], 1500.0)
        counts = run.worker("imu").driver.counts
        sent = len(select_imu_frames(messages))
        wait_for(lambda: counts.received + counts.bad >= sent, "the last frame")
    assert (counts.received, counts.bad, counts.lost) == (sent, 0, 0)
    want = read_expected_values(folder / f"{name}.npz")[:sent]
    assert (np.abs(run.output.values("imu") - want) <= HALF_LSB).all()
