"""Reading of ROS 2 bags with sensor_msgs/Imu at 400 Hz: memory against length, and speed beside rosbags.

    python -m tests.experiments.benchmarks.bench_bag [--hours 10] [--storage sqlite3 mcap] [--folder FOLDER]

The bags are generated in a temporary folder of FOLDER and have the given length and a tenth of it. A separate process
reads each bag with ``load_samples`` and passes all blocks to a sum, as the command ``analyze`` does. Another process
iterates the same bag with rosbags and deserializes each message. Both must find the same sums.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from tests.experiments.benchmarks.machine import Load, console, create_table, describe_machine

RATE_HZ: Final = 400
START_NS: Final = 1_763_700_000_123_456_789
BLOCK_ROWS: Final = 1 << 16
IMU: Final = "sensor_msgs/msg/Imu"
ROW_BYTES: Final = 64
"""Size of a sample in memory: the time, six axes and the temperature with 8 bytes each."""
MESSAGE: Final = np.dtype(
    [
        ("encapsulation", "S4"), ("sec", "<i4"), ("nanosec", "<u4"), ("text_bytes", "<u4"), ("text", "S12"),
        ("orientation", "<f8", 13), ("gyro", "<f8", 12), ("accel", "<f8", 12),
    ]
)  # fmt: skip
"""Message in XCDR1 with the frame_id ``imu_link``. Nine covariances follow each quantity."""
READ_FUNCTIONS: Final = """
import re, sys, time
from pathlib import Path
import psutil

def read_with_imu_monitor(path):
    from drivers.recordings import iter_blocks, load_samples
    recording = load_samples(path)
    rows = stamps = 0
    total = 0.0
    for block in iter_blocks(recording):
        rows += len(block)
        stamps += int((block.t_ns % 1_000_000_000).sum())
        total += float(block.values.sum())
    return rows, stamps, total

def read_with_rosbags(path):
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore
    store = get_typestore(Stores.ROS2_HUMBLE)
    rows = stamps = 0
    total = 0.0
    with Reader(path) as reader:
        for connection, _, data in reader.messages():
            message = store.deserialize_cdr(data, connection.msgtype)
            gyro, accel = message.angular_velocity, message.linear_acceleration
            rows += 1
            stamps += message.header.stamp.nanosec
            total += gyro.x + gyro.y + gyro.z + accel.x + accel.y + accel.z
    return rows, stamps, total

read = {"imu-monitor": read_with_imu_monitor, "rosbags": read_with_rosbags}[sys.argv[1]]
read(Path(sys.argv[2]))  # imports the libraries
before = psutil.Process().memory_info().rss
start_s = time.process_time()
found = read(Path(sys.argv[3]))
seconds = time.process_time() - start_s
# Unlike ru_maxrss, VmHWM does not include the memory of the parent process before the program was loaded.
peak = 1024 * int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1])
print(*found, seconds, peak - before, sep=";")
"""


def write_bag(path: Path, storage: StoragePlugin, seconds: float) -> Path:
    """Write a bag with white noise, block by block, and return its path."""
    rng = np.random.default_rng(0)
    store = get_typestore(Stores.ROS2_HUMBLE)
    rows = round(seconds * RATE_HZ)
    with Writer(path, version=9, storage_plugin=storage) as writer:
        connection = writer.add_connection("/imu/data", IMU, typestore=store)
        for start in range(0, rows, BLOCK_ROWS):
            index = np.arange(start, min(start + BLOCK_ROWS, rows))
            t_ns = START_NS + index * (1_000_000_000 // RATE_HZ)
            block = np.zeros(index.size, MESSAGE)
            block["encapsulation"], block["text_bytes"], block["text"] = b"\0\1\0\0", 9, b"imu_link\0"
            block["sec"], block["nanosec"] = np.divmod(t_ns, 1_000_000_000)
            block["gyro"][:, :3] = 1e-3 * rng.standard_normal((index.size, 3))
            block["accel"][:, :3] = 1e-2 * rng.standard_normal((index.size, 3)) + [0.0, 0.0, 9.81]
            data = block.tobytes()
            for i, log_ns in enumerate(t_ns.tolist()):
                writer.write(connection, log_ns, data[i * MESSAGE.itemsize : (i + 1) * MESSAGE.itemsize])
    return path


def measure(program: str, short: Path, bag: Path) -> tuple[tuple[int, int], float, float, float]:
    """Return the number of messages and the sum of the stamps, the sum of the values, the processor time in s, and the
    additional peak memory in MB."""
    run = subprocess.run(
        [sys.executable, "-c", READ_FUNCTIONS, program, str(short), str(bag)],
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        cwd=Path(__file__).parents[3],
        check=True,
        capture_output=True,
        text=True,
    )
    rows, stamps, total, seconds, peak_bytes = run.stdout.split(";")
    return (int(rows), int(stamps)), float(total), float(seconds), float(peak_bytes) / 1e6


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--hours", type=float, default=10.0)
    parser.add_argument("--storage", nargs="+", default=["sqlite3", "mcap"], choices=["sqlite3", "mcap"])
    parser.add_argument("--folder", type=Path, default=None, help="folder for the bags; 0.5 GB per hour and storage")
    arguments = parser.parse_args()
    console.print(describe_machine())
    table = create_table(
        f"bags with {IMU} at {RATE_HZ} Hz", "storage", "program", "messages", "processor time, s",
        "messages/s", "peak memory, MB", "above the samples, MB",
    )  # fmt: skip
    load = Load()
    for storage in arguments.storage:
        for hours in (arguments.hours / 10.0, arguments.hours):
            with tempfile.TemporaryDirectory(dir=arguments.folder) as name:
                folder = Path(name)
                short = write_bag(folder / "short", StoragePlugin[storage.upper()], 10.0)
                bag = write_bag(folder / "bag", StoragePlugin[storage.upper()], hours * 3600.0)
                results = {program: measure(program, short, bag) for program in ("imu-monitor", "rosbags")}
            (ours, sum_of_ours, *_), (theirs, sum_of_theirs, *_) = results.values()
            assert ours == theirs
            np.testing.assert_allclose(sum_of_ours, sum_of_theirs, rtol=1e-9)
            for program, ((rows, _), _, seconds, peak_mb) in results.items():
                samples_mb = rows * ROW_BYTES / 1e6 if program == "imu-monitor" else 0.0
                table.add_row(
                    storage, program, str(rows), f"{seconds:.1f}", f"{rows / seconds:.3g}", f"{peak_mb:.1f}",
                    f"{peak_mb - samples_mb:.1f}",
                )  # fmt: skip
    console.print(table)
    console.print(load.describe())


if __name__ == "__main__":
    main()
