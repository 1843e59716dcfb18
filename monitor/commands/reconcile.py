"""The work of ``imu-monitor reconcile``: a recording from its file, the comparison in threads, and the folder it
leaves.

``DIR/`` gets ``report.html``, ``report.json``, ``model.toml`` and ``reconcile.rrd``; each appears whole or not at all.
Where the data do not support an answer there is ``report.json`` alone, and it says why. Kernels and transforms run
without the GIL, so that axes and simulated recordings are looked at side by side.

Several recordings are compared with one model, one after the other, each into a folder of its own in ``DIR/``; what
they have in common and what only some show goes to ``DIR/`` itself.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from drivers.errors import ConfigError, NotReady, RecordingError
from drivers.file_access import real_path
from drivers.recordings import FORMATS, iter_blocks, load_samples
from drivers.recordings import Recording as Samples
from drivers.recordings.writing import whole
from drivers.sample import AXES
from monitor.estimation.regular_grid import with_temperature
from monitor.noise.model import NoiseModel
from monitor.reconcile.reconcile import Recording, reconcile
from monitor.reconcile.report import SCHEMA, to_json
from monitor.reconcile.result import Reconciliation
from monitor.reconcile.several_recordings import comparison_report
from monitor.reconcile.several_recordings.comparison import Comparison, Run, compare

Tell = Callable[[str, float | None], None]
"""Told what is being done, and the share that is done where that is known."""
REPORT: Final = "report.json"


@dataclass(frozen=True, slots=True)
class Request:
    """What is to be compared."""

    recording: Path
    model: NoiseModel | None  # None: the five terms are fitted first
    out: Path
    seed: int = 1
    rate_hz: float | None = None
    notes: tuple[str, ...] = ()  # what is to be said besides
    last_s: float | None = None  # the end of the recording alone


@dataclass(frozen=True, slots=True)
class RunsRequest:
    """Several recordings of one sensor, to be compared with one model."""

    recordings: tuple[Path, ...]
    model: NoiseModel | None  # None: the five terms are fitted to the first recording
    out: Path
    seed: int = 1
    rate_hz: float | None = None
    last_s: float | None = None  # the end of each alone


def make(request: Request, tell: Tell = lambda _what, _share: None) -> Reconciliation:
    """Read, compare, and write the folder.

    Raises:
        RecordingError, ConfigError: no recording, or a folder that cannot be written
        NotReady: the data do not support an answer; the folder says why
    """
    tell("reading", None)
    found = load_samples(request.recording, request.rate_hz, request.last_s)
    check_folder(request.out)
    try:
        recording, notes = _recording(found)
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            result = reconcile(recording, request.model, request.seed, pool.map, lambda what: tell(what, None))
    except NotReady as error:
        _write(request.out / REPORT, no_answer(str(error), len(found)))
        raise
    result = replace(result, notes=(*request.notes, *found.notes, *notes, *result.notes))
    tell("writing", None)
    write(result, request.out, request.recording.name)
    return result


def make_runs(request: RunsRequest, tell: Tell = lambda _what, _share: None) -> Comparison:
    """Compare each by itself, then all with each other, and write the folders.

    Raises:
        RecordingError, ConfigError: as ``make``; a recording that is given twice
        NotReady: the first supports no answer where the model was to be fitted to it, or fewer than two do
    """
    named = names(request.recordings)
    _check_recordings(named, request.out)
    check_folder(request.out)
    model, runs, silent = request.model, list[Run](), dict[str, str]()
    fitted_to = next(iter(named)) if model is None else None
    for at, (name, path) in enumerate(named.items(), start=1):
        notes = (f"The model under test are the five terms of {fitted_to}.",) if fitted_to and at > 1 else ()
        one = Request(path, model, request.out / name, request.seed, request.rate_hz, notes, request.last_s)
        try:
            result = make(one, _told(tell, f"{name}, {at} of {len(named)}"))
        except NotReady as error:
            silent[name] = str(error)
            if model is None:
                break
            continue
        model = result.baseline
        runs.append(Run(name, result))
    if len(runs) < 2:
        why = "; ".join(f"{name}: {said}" for name, said in silent.items())
        why = f"two recordings at least are compared with each other, and {len(runs)} can be: {why}"
        _write(request.out / REPORT, no_answer(why, 0, comparison_report.SCHEMA))
        raise NotReady(why)
    tell("writing", None)
    comparison = compare(runs, fitted_to, silent)
    write_runs(comparison, request.out)
    return comparison


def write_runs(result: Comparison, folder: Path) -> None:
    """What is said of all recordings together."""
    from monitor.publishing.reports.comparison_page import page

    _write(folder / REPORT, comparison_report.to_json(result))
    _write(folder / "model.toml", result.model.to_toml().encode())
    _write(folder / "report.html", page(result).encode())


def names(recordings: Sequence[Path]) -> dict[str, Path]:
    """Name -> recording: that of the file without its suffix, with a number where two would be the same.

    >>> list(names([Path("a/run.csv"), Path("b/run.csv.gz"), Path("c/warm.npz")]))
    ['run', 'run-2', 'warm']
    """
    found: dict[str, Path] = {}
    for path in recordings:
        if real_path(path) in [real_path(other) for other in found.values()]:
            raise ConfigError(f"{path}: is given twice; recordings that are compared must be different ones")
        full = real_path(path).name
        suffix = next((one for one in FORMATS if full.lower().endswith(one)), "")
        stem = full[: len(full) - len(suffix)] or full
        possible = (stem, *(f"{stem}-{k}" for k in range(2, len(recordings) + 1)))
        found[next(name for name in possible if name not in found)] = path
    return found


def _check_recordings(named: Mapping[str, Path], out: Path) -> None:
    """Before the first of them is worked on: all are there, and none would be written into."""
    for path in named.values():
        if not path.exists():
            raise RecordingError(f"{path}: cannot be read: there is no such file or folder")
        if any(real_path(out / name) == real_path(path) for name in named):
            raise ConfigError(f"--out: {out}: {path} is a recording, and a report would be written into it")


def _told(tell: Tell, which: str) -> Tell:
    return lambda what, share: tell(f"{which}: {what}", share)


def write(result: Reconciliation, folder: Path, title: str) -> None:
    """All four files."""
    from monitor.publishing.reports.reconcile_page import page

    _write(folder / REPORT, to_json(result))
    _write(folder / "model.toml", result.model.to_toml().encode())
    _write(folder / "report.html", page(result, title).encode())
    try:
        from monitor.publishing.reports.reconcile_rrd import write_rrd
    except ImportError:  # the viewer's library is optional
        return
    with whole(folder / "reconcile.rrd") as place:
        write_rrd(result, place)


def no_answer(why: str, samples: int, schema: str = SCHEMA) -> bytes:
    """``report.json`` where there is no verdict."""
    return msgspec.json.encode({"schema": schema, "verdict": None, "why": why, "samples": samples})


def check_folder(folder: Path) -> None:
    """Make the folder; ConfigError where it cannot be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out: {folder}: cannot be made: {error.strerror}") from error


def _recording(found: Samples) -> tuple[Recording, list[str]]:
    """On a regular grid, in the axes that the file has."""
    values, temperature_c, rate_hz, notes = with_temperature(list(iter_blocks(found)), found.rate_hz)
    columns = {axis: np.ascontiguousarray(values[:, AXES.index(axis)], np.float64) for axis in found.axes}
    return Recording(columns, rate_hz, temperature_c), notes


def _write(path: Path, data: bytes) -> None:
    with whole(path) as place:
        place.write_bytes(data)
