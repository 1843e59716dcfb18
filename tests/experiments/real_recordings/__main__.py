"""Table of ``reconcile`` on real recordings: ``python -m tests.experiments.real_recordings``, with IMU_MONITOR_DATA.

Each recording is compared with the five terms that are fitted to the recording. If a sensor has several runs, or if a
recording can be divided into halves, the later part is also compared with the model that ``reconcile`` writes for the
earlier part. The table lists the number of findings, the explained share of the difference, the findings that an
independent check confirms, the processor time, and the peak memory of the program.
"""

import argparse
import json
import os
import statistics
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from tests.experiments.real_recordings.independent_checks import CheckedRecording, check_effect

AXES: Final = ("gx", "gy", "gz", "ax", "ay", "az")


@dataclass(frozen=True)
class Case:
    """Section of a recording and the case whose model is tested."""

    name: str
    file: str
    first: int = 0
    last: int | None = None
    model_of: str | None = None  # None: the five terms
    moved_s: tuple[float, float] | None = None  # time of a known motion of the sensor, which the checks leave out, s


CASES: Final = (
    Case("adis16405 run 1", "adis16405/run1.npz"),
    Case("adis16405 run 2", "adis16405/run2.npz"),
    Case("adis16405 run 6", "adis16405/run6.npz"),
    Case("adis16405 run 2, model of run 1", "adis16405/run2.npz", model_of="adis16405 run 1"),
    Case("adis16405 run 6, model of run 1", "adis16405/run6.npz", model_of="adis16405 run 1"),
    Case("xsens-mtig gx", "xsens-mtig/contaminated-gx.npz"),
    Case("ig500n", "ig500n/static-2h.npz"),
    Case("ig500n, first half", "ig500n/static-2h.npz", 0, 18_286),
    Case("ig500n, second half", "ig500n/static-2h.npz", 18_286, None, "ig500n, first half"),
    Case("phone", "phone/gyro-a.npz"),
    Case("phone, first half", "phone/gyro-a.npz", 0, 18_952),
    Case("phone, second half", "phone/gyro-a.npz", 18_952, None, "phone, first half"),
    Case("mpu6050-arduino", "mpu6050-arduino/static-7min.npz"),
    Case("mpu6050-arduino, first half", "mpu6050-arduino/static-7min.npz", 0, 22_465),
    Case(
        "mpu6050-arduino, second half", "mpu6050-arduino/static-7min.npz", 22_465, None, "mpu6050-arduino, first half"
    ),
    Case("mpu6050-hosttime", "mpu6050-hosttime/static-11min.npz"),
    Case("mpu6050-hosttime, first half", "mpu6050-hosttime/static-11min.npz", 0, 32_533),
    Case(
        "mpu6050-hosttime, second half",
        "mpu6050-hosttime/static-11min.npz",
        32_533,
        None,
        "mpu6050-hosttime, first half",
    ),
    Case("vn100", "vn100-serial/static-12min.npz", moved_s=(741.0, 745.0)),
    Case("vn100, first half", "vn100-serial/static-12min.npz", 0, 15_089),
    Case(
        "vn100, second half",
        "vn100-serial/static-12min.npz",
        15_089,
        None,
        "vn100, first half",
        moved_s=(363.7, 367.7),
    ),
    Case("px4-bench", "px4-bench/bench-69s.npz", moved_s=(1.7, 7.1)),
)


@dataclass(frozen=True)
class Row:
    """Result of one case."""

    name: str
    verdict: str
    findings: int
    explained: float
    checked: tuple[tuple[str, str, bool, str], ...]  # axis, effect, confirmed, evidence
    processor_s: float
    peak_mb: float

    @property
    def confirmed(self) -> int:
        """Number of findings that the independent check confirms."""
        return sum(one[2] for one in self.checked)


def main() -> None:
    """Run the cases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", default=[""], help="run the cases whose name contains one of the texts")
    parser.add_argument("--evidence", action="store_true", help="print the evidence for each finding")
    options = parser.parse_args()
    data = os.environ.get("IMU_MONITOR_DATA")
    if not data:
        sys.exit("IMU_MONITOR_DATA is not set; set the variable to the folder of the recordings")
    print("| recording | result | findings | explained share | confirmed | doubtful | processor time, s | memory, MB |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        rows = []
        for case in _selected_cases(options.only):
            row = run_case(case, Path(data), Path(folder))
            rows.append(row)
            doubtful = len(row.checked) - row.confirmed
            print(
                f"| {row.name} | {row.verdict} | {row.findings} | {row.explained:.1%} | {row.confirmed} | {doubtful} "
                f"| {row.processor_s:.1f} | {row.peak_mb:.0f} |",
                flush=True,
            )
            if options.evidence:
                for axis, effect, confirmed, text in row.checked:
                    print(f"    {'confirmed' if confirmed else 'doubtful '} {axis} {effect}: {text}", flush=True)
    checked = [one for row in rows for one in row.checked]
    doubtful_share = sum(not one[2] for one in checked) / max(len(checked), 1)
    print(f"median explained share {statistics.median(row.explained for row in rows):.1%}")
    print(f"doubtful findings {doubtful_share:.1%} of {len(checked)}")


def _selected_cases(texts: Sequence[str]) -> Iterator[Case]:
    """Yield the cases whose name contains one of the texts, and the cases whose model is needed."""
    chosen = {case.name for case in CASES if any(text in case.name for text in texts)}
    chosen |= {case.model_of for case in CASES if case.name in chosen and case.model_of}
    return (case for case in CASES if case.name in chosen)


def run_case(case: Case, data: Path, folder: Path) -> Row:
    """Run ``reconcile`` on one case and check the findings.

    Parameters
    ----------
    case : Case
        Section of a recording.
    data : Path
        Folder of the recordings.
    folder : Path
        Folder for the reports, which also contains the reports of earlier cases.
    """
    with np.load(data / case.file) as archive:
        columns = {name: archive[name] for name in archive.files}
    size = columns[next(axis for axis in AXES if axis in columns)].size
    section = {
        name: values[case.first : case.last] if values.shape == (size,) else values for name, values in columns.items()
    }
    recording_path, out = folder / "section.npz", folder / _folder_name(case.name)
    np.savez(recording_path, **section)
    arguments = ["reconcile", str(recording_path), "--out", str(out)]
    if case.model_of:
        arguments += ["--model", str(folder / _folder_name(case.model_of) / "model.toml")]
    processor_s, peak_mb = _run_program(arguments)
    report = json.loads((out / "report.json").read_text())
    recording = _fill_missing(section, float(report["rate"]), case.moved_s)
    checked = tuple(
        (axis, effect, check.confirmed, check.evidence)
        for axis, effect, parameters in _reported_effects(report)
        for check in [check_effect(recording, axis, effect, parameters)]
        if check is not None
    )
    return Row(
        case.name, report["verdict"], len(report["findings"]), report["explained_share"], checked, processor_s, peak_mb
    )


def _folder_name(case_name: str) -> str:
    return case_name.replace(" ", "-").replace(",", "")


def _run_program(arguments: list[str]) -> tuple[float, float]:
    """Run imu-monitor, and return the processor time in seconds and the peak memory in MB."""
    process = os.posix_spawn(
        sys.executable,
        [sys.executable, "-m", "imu_monitor", *arguments],
        os.environ,
        file_actions=[(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)],
    )
    _, status, usage = os.wait4(process, 0)
    if os.waitstatus_to_exitcode(status) != 0:
        sys.exit(f"imu-monitor {' '.join(arguments)}: exit status {os.waitstatus_to_exitcode(status)}")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024.0


def _fill_missing(section: Mapping[str, Any], rate_hz: float, moved_s: tuple[float, float] | None) -> CheckedRecording:
    """Return the samples of a section, with missing samples and samples in motion interpolated."""

    def fill(x: Any) -> Any:
        x = np.asarray(x, np.float64)
        known = np.isfinite(x)
        if moved_s is not None:
            known[round(moved_s[0] * rate_hz) : round(moved_s[1] * rate_hz)] = False
        return np.interp(np.arange(x.size), np.flatnonzero(known), x[known])

    temperature = section.get("temp")
    return CheckedRecording(
        {axis: fill(section[axis]) for axis in AXES if axis in section},
        rate_hz,
        None if temperature is None else fill(temperature),
    )


def _reported_effects(report: Mapping[str, Any]) -> Iterator[tuple[str, str, dict[str, float | str]]]:
    for axis, result in report["axes"].items():
        for step in result["steps"]:
            if step["kind"] == "added":
                parameters = {name: entry["value"] for name, entry in step["parameters"].items()}
                yield axis, step["effect"], {name: value for name, value in parameters.items() if value is not None}


if __name__ == "__main__":
    main()
