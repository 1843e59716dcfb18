"""Tests that commands reject hostile files with one line and status 2, with limited memory and processor time.

A command reads each file in a separate process with limited address space and processor time. The process records its
largest resident memory. The cases that are quick to generate run by default. The other cases run with
``pytest tests/experiments/attacks -m attack``.
"""

import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from tests.experiments.attacks import hostile_files as hostile

ROOT: Final = Path(__file__).resolve().parents[3]
MAX_RESIDENT_BYTES: Final = 500_000_000
ADDRESS_SPACE_BYTES: Final = 4_000_000_000
CPU_S: Final = 40
"""Limit of processor time, which is four times the limit on an idle machine."""

RUN_LIMITED: Final = f"""
import resource, runpy, sys
resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[2]), int(sys.argv[2])))
resource.setrlimit(resource.RLIMIT_CPU, ({CPU_S}, {CPU_S}))
peak, sys.argv[:] = sys.argv[1], ["imu-monitor", *sys.argv[3:]]
try:
    runpy.run_module(sys.argv.pop(1), run_name="__main__", alter_sys=True)
finally:
    with open("/proc/self/status") as status, open(peak, "w") as file:
        file.write(next(line for line in status if line.startswith("VmHWM")))
"""


@dataclass(frozen=True)
class ProcessResult:
    """Result of a process with limited resources."""

    status: int
    stdout: str
    stderr: str
    resident_bytes: int  # largest resident memory


def run_limited(
    tmp_path: Path, module: str, *args: str, address_space_bytes: int = ADDRESS_SPACE_BYTES
) -> ProcessResult:
    """Run a module as a program in a process with limited resources."""
    peak = tmp_path / "peak"
    command = [sys.executable, "-c", RUN_LIMITED, str(peak), str(address_space_bytes), module, *args]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=900, check=False)
    resident = 1024 * int(peak.read_text().split()[1]) if peak.exists() else sys.maxsize
    return ProcessResult(done.returncode, done.stdout, done.stderr, resident)


def check_rejected(result: ProcessResult, path: Path, reason: str) -> None:
    """Check that a file was rejected in one line that contains its path and the reason."""
    assert result.status == 2, result
    assert result.stderr.count("\n") == 1, result.stderr
    assert str(path) in result.stderr
    assert re.search(reason, result.stderr), result.stderr
    assert result.stdout == ""
    assert result.resident_bytes < MAX_RESIDENT_BYTES, result


Case = tuple[hostile.Generator, str, str]
"""Generator, suffix of its file, and pattern of the message."""

MEMORY_OR_ROWS: Final = "of memory would be needed|are not measured samples"
QUICK_CASES: Final[Sequence[Case]] = (
    (hostile.csv_hundred_thousand_columns, ".csv", "100002 columns, expected at most 10000"),
    (hostile.csv_line_without_end, ".csv", "Line 2 is longer than 1048576 bytes"),
    (hostile.gz_header_without_end, ".csv.gz", "not one complete line.*Line 1 is longer"),
    (hostile.gz_rows_without_end, ".csv.gz", MEMORY_OR_ROWS),
    (hostile.gz_bad_lines, ".csv.gz", f"lines are not samples|{MEMORY_OR_ROWS}"),
    (hostile.npz_zeros, ".npz", MEMORY_OR_ROWS),
    (hostile.npz_shape_claims, ".npz", MEMORY_OR_ROWS),
    (hostile.npz_header_without_end, ".npz", "not an array in the format .npy"),
    (hostile.npz_objects, ".npz", "gx contains Python objects"),
    (hostile.arrow_nulls, ".arrow", MEMORY_OR_ROWS),
    (hostile.arrow_run_ends, ".arrows", "gx contains run_end_encoded"),
    (hostile.folder_of_bombs, "", "none of 9 segments can be read|of memory would be needed"),
)
SLOW_CASES: Final[Sequence[Case]] = (
    (hostile.csv_header_without_end, ".csv", "Line 1 is longer"),
    (hostile.csv_ten_million_columns, ".csv", "Line 1 is longer"),
    (hostile.gz_comments_without_end, ".csv.gz", "no header line within its first|are not measured samples|of memory"),
    (hostile.gz_line_without_end, ".csv.gz", "Line 2 is longer"),
    (hostile.gz_noise_then_rows_without_end, ".csv.gz", MEMORY_OR_ROWS),
    (hostile.gz_blank_lines, ".csv.gz", MEMORY_OR_ROWS),
    (hostile.gz_long_lines, ".csv.gz", "unpacks to more than 2.0 GB"),
    (hostile.gz_empty_members, ".csv.gz", "consecutive gzip members are empty"),
    (hostile.gz_in_gz, ".csv.gz", "is no CSV text"),
    (hostile.npz_sizes_claim, ".npz", f"{MEMORY_OR_ROWS}|its data hold|is damaged"),
    (hostile.npz_two_dimensions, ".npz", "expected one dimension"),
    (hostile.npz_long_strings, ".npz", "expected numbers"),
    (hostile.npz_nested, ".npz", "not an array in the format .npy"),
    (hostile.npz_members, ".npz", "its index of arrays is damaged"),
    (hostile.npz_cut_zeros, ".npz", f"unpacks to more than|{MEMORY_OR_ROWS}"),
    (hostile.npz_cut_members, ".npz", "expected at most 10000"),
    (hostile.npz_bzip2, ".npz", f"packed by method 12|{MEMORY_OR_ROWS}"),
    (hostile.parquet_nulls, ".parquet", MEMORY_OR_ROWS),
    (hostile.parquet_equal_rows, ".parquet", MEMORY_OR_ROWS),
    (hostile.parquet_columns, ".parquet", "the index of row groups and columns has"),
    (hostile.parquet_long_strings, ".parquet", "gx contains dictionary"),
    (hostile.arrow_nulls, ".arrows", MEMORY_OR_ROWS),
    (hostile.arrow_zeros, ".arrow", MEMORY_OR_ROWS),
    (hostile.arrow_zeros, ".arrows", MEMORY_OR_ROWS),
    (hostile.arrow_buffer_claims, ".arrow", "batch 1 is damaged"),
    (hostile.arrow_columns, ".arrows", "100001 columns, expected at most 10000"),
    (hostile.folder_of_fitting_parts, "", MEMORY_OR_ROWS),
)


def get_case_id(case: object) -> str | None:
    """Return the name of a generator for the identifier of a test."""
    return getattr(case, "__name__", None)


def check_analyze_rejects(tmp_path: Path, generate: hostile.Generator, suffix: str, reason: str) -> None:
    """Check that ``analyze`` rejects a generated file."""
    path = tmp_path / f"hostile{suffix}"
    generate(path)
    check_rejected(run_limited(tmp_path, "imu_monitor", "analyze", str(path), "--rate", "100"), path, reason)


@pytest.mark.timeout(900)
@pytest.mark.parametrize(("generate", "suffix", "reason"), QUICK_CASES, ids=get_case_id)
def test_analyze_rejects_hostile_file_in_one_line(
    tmp_path: Path, generate: hostile.Generator, suffix: str, reason: str
) -> None:
    check_analyze_rejects(tmp_path, generate, suffix, reason)


@pytest.mark.attack
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("generate", "suffix", "reason"), SLOW_CASES, ids=get_case_id)
def test_analyze_rejects_slow_cases_in_one_line(
    tmp_path: Path, generate: hostile.Generator, suffix: str, reason: str
) -> None:
    check_analyze_rejects(tmp_path, generate, suffix, reason)


@pytest.mark.attack
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    "command",
    [("reconcile", "--out", "report"), ("compensate", "--out", "out.csv"), ("thermal", "fit", "--out", "model.json")],
    ids=lambda command: command[0],
)
def test_other_commands_reject_hostile_file_in_one_line(tmp_path: Path, command: tuple[str, ...]) -> None:
    path = tmp_path / "hostile.csv.gz"
    hostile.gz_rows_without_end(path)
    *words, out = command
    result = run_limited(tmp_path, "imu_monitor", *words, str(tmp_path / out), str(path), "--rate", "100")
    check_rejected(result, path, MEMORY_OR_ROWS)


@pytest.mark.parametrize("generate", [hostile.arrow_other_column, hostile.npz_large_rate], ids=get_case_id)
def test_large_unused_column_needs_little_memory(tmp_path: Path, generate: Callable[[Path], None]) -> None:
    """The few samples beside a large unused column are read, and are too few for an analysis."""
    path = tmp_path / f"hostile{'.npz' if generate is hostile.npz_large_rate else '.arrows'}"
    generate(path)
    result = run_limited(tmp_path, "imu_monitor", "analyze", str(path), "--rate", "100")
    assert result.status == 3, result
    assert result.stderr.count("\n") == 1
    assert result.resident_bytes < MAX_RESIDENT_BYTES


LOG_CASES: Final[Sequence[Case]] = (
    *((hostile.log_line_without_end, f"{suffix}.gz", "a line is longer than") for suffix in hostile.LOG_STARTS),
    (hostile.log_blank_lines, ".asc.gz", "8000000 bytes hold no CAN frame"),
    (hostile.log_blank_lines, ".log.gz", "8000000 bytes hold no CAN frame"),
    (hostile.log_blank_lines, ".trc.gz", "8000000 bytes hold no CAN frame"),
    (hostile.blf_container, ".blf", "a container unpacks to more than"),
    (hostile.blf_gz_object, ".blf.gz", "an object has 3221225472 bytes"),
    (hostile.npz_zeros, ".npz", MEMORY_OR_ROWS),
    (hostile.gz_rows_without_end, ".csv.gz", MEMORY_OR_ROWS),
)  # fmt: skip


@pytest.mark.attack
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("generate", "suffix", "reason"), LOG_CASES, ids=lambda value: get_case_id(value) or None)
def test_replay_rejects_hostile_log_in_one_line(
    tmp_path: Path, generate: hostile.Generator, suffix: str, reason: str
) -> None:
    path = tmp_path / f"hostile{suffix}"
    generate(path)
    check_rejected(run_limited(tmp_path, "tests.experiments.attacks.replay_to_end", str(path)), path, reason)


# --- valid recordings of the same shape ------------------------------------------------------------


def npz_of_zeros(path: Path) -> None:
    """Write 10^7 rows of six columns of zeros, about 470 kB."""
    np.savez_compressed(path, **{axis: np.zeros(10**7) for axis in ("gx", "gy", "gz", "ax", "ay", "az")})


def parquet_of_zeros(path: Path) -> None:
    """Write 10^7 rows of six columns of zeros, some kilobytes."""
    import pyarrow as pa
    from pyarrow import parquet

    parquet.write_table(pa.table({axis: np.zeros(10**7) for axis in ("gx", "gy", "gz", "ax", "ay", "az")}), path)


def gz_of_zeros(path: Path) -> None:
    """Write 10^7 rows of six columns of zeros with a compression ratio of a thousand, 240 kB."""
    hostile_rows = hostile.build_gzip(b"gx,gy,gz,ax,ay,az\n", b"0,0,0,0,0,0\n", 120_000_000)
    path.write_bytes(hostile_rows)


def gz_of_steps(path: Path) -> None:
    """Write more than 10^7 rows with coarse steps, which repeat the same 200 rows."""
    rng = np.random.default_rng(1)
    rows = np.round(rng.normal(size=(200, 6))).astype(int)
    block = "".join(",".join(f"{n * 0.0078125:g}" for n in row) + "\n" for row in rows)
    path.write_bytes(hostile.build_gzip(b"gx,gy,gz,ax,ay,az\n", block.encode(), 10**7 // 200 * len(block)))


@pytest.mark.attack
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("generate", "suffix"),
    [(gz_of_zeros, ".csv.gz"), (gz_of_steps, ".csv.gz"), (npz_of_zeros, ".npz"), (parquet_of_zeros, ".parquet")],
    ids=get_case_id,
)
def test_large_valid_recording_with_high_compression_ratio_is_read(
    tmp_path: Path, generate: hostile.Generator, suffix: str
) -> None:
    path = tmp_path / f"valid{suffix}"
    generate(path)
    program = "import sys; from pathlib import Path; from drivers.recordings import load_samples; "
    program += "found = load_samples(Path(sys.argv[1]), 100.0); print(len(found), *found.axes, *found.notes)"
    done = subprocess.run(
        [sys.executable, "-c", program, str(path)], capture_output=True, text=True, cwd=ROOT, timeout=900, check=False
    )
    assert done.returncode == 0, done.stderr
    rows, *axes = done.stdout.split()
    assert int(rows) >= 10**7
    assert axes == ["gx", "gy", "gz", "ax", "ay", "az"]
