"""Command ``reconcile``: compares recordings with a noise model and writes the report.

The report consists of ``report.html``, ``report.json``, ``model.toml`` and, if an axis differs from the model,
``reconcile.rrd``. If the data do not support an answer, only ``report.json`` is written, with the reason. If several
recordings are compared, the report of each recording is written to a subfolder.
"""

import logging
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from drivers.data_types import AXES
from drivers.errors import ConfigError, NotReady, RecordingError
from drivers.host.safe_file_reading import real_path
from drivers.recordings import FORMATS, iter_blocks
from drivers.recordings import Recording as Samples
from drivers.recordings.writing import atomic_write_path
from monitor.commands.progress_callback import ProgressCallback, ignore_progress
from monitor.commands.recording_loading import DEFAULT_LOADING, LoadingOptions, load_recording
from monitor.common.unit_formatting import DEFAULT_UNITS, UnitSystem
from monitor.estimation.regular_grid import place_samples_on_grid
from monitor.noise.model import NoiseModel
from monitor.reconcile.json_report import COMPARISON_SCHEMA, SCHEMA, encode_comparison, encode_report
from monitor.reconcile.preparation.reconcile_input import RecordedAxes
from monitor.reconcile.reconcile import reconcile
from monitor.reconcile.result import Reconciliation
from monitor.reconcile.several_recordings.comparison import NamedResult, RecordingsComparison, compare_results

REPORT: Final = "report.json"


def reconcile_and_write_report(
    recording: Path,
    model: NoiseModel | None,
    out: Path,
    seed: int = 1,
    loading: LoadingOptions = DEFAULT_LOADING,
    notes: Sequence[str] = (),
    report_progress: ProgressCallback = ignore_progress,
    units: UnitSystem = DEFAULT_UNITS,
) -> Reconciliation:
    """Compare a recording with a noise model and write the report.

    Parameters
    ----------
    recording : Path
        Recording to read.
    model : NoiseModel or None
        Noise model to test. None fits the five noise terms to the recording.
    out : Path
        Folder for the report.
    seed : int, optional
        Seed of the random numbers.
    loading : LoadingOptions, optional
        Options for reading the recording.
    notes : sequence of str, optional
        Additional notes for the report.
    report_progress : callable, optional
        Progress callback.
    units : UnitSystem, optional
        Units of the report.

    Raises
    ------
    RecordingError, ConfigError
        If the recording cannot be read, or if the folder cannot be written.
    NotReady
        If the data do not support an answer.
    """
    found = load_recording(recording, loading, report_progress)
    create_report_folder(out)
    try:
        result = reconcile_recording(found, model, seed, notes, report_progress)
    except NotReady as error:
        _write(out / REPORT, _encode_failure(str(error), len(found)))
        raise
    report_progress("writing", None)
    write_report(result, out, recording.name, units)
    return result


def reconcile_recording(
    found: Samples,
    model: NoiseModel | None,
    seed: int = 1,
    notes: Sequence[str] = (),
    report_progress: ProgressCallback = ignore_progress,
) -> Reconciliation:
    """Compare a recording that has been read with a noise model.

    Parameters
    ----------
    found : drivers.recordings.Recording
        Recorded samples.
    model : NoiseModel or None
        Noise model to test. None fits the five noise terms to the recording.
    seed : int, optional
        Seed of the random numbers.
    notes : sequence of str, optional
        Notes that precede the notes of the result.
    report_progress : callable, optional
        Progress callback.

    Raises
    ------
    NotReady
        If the data do not support an answer.
    """
    recording, grid_notes = _to_regular_grid(found)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        result = reconcile(recording, model, seed, pool.map, report_progress)
    for failure in result.failed_candidates:
        logging.getLogger(__name__).debug("candidate effect dropped: %s", failure)
    return replace(result, notes=(*notes, *found.notes, *grid_notes, *result.notes))


def compare_recordings(
    recordings: Sequence[Path],
    model: NoiseModel | None,
    out: Path,
    seed: int = 1,
    loading: LoadingOptions = DEFAULT_LOADING,
    report_progress: ProgressCallback = ignore_progress,
    units: UnitSystem = DEFAULT_UNITS,
) -> RecordingsComparison:
    """Compare several recordings with a noise model and with each other, and write the reports.

    Parameters
    ----------
    recordings : sequence of Path
        Recordings of one sensor.
    model : NoiseModel or None
        Noise model to test. None fits the five noise terms to the first recording.
    out : Path
        Folder for the reports.
    seed : int, optional
        Seed of the random numbers.
    loading : LoadingOptions, optional
        Options for reading the recordings.
    report_progress : callable, optional
        Progress callback.
    units : UnitSystem, optional
        Units of the report.

    Raises
    ------
    RecordingError, ConfigError
        If a recording cannot be read or is given twice, or if the folder cannot be written.
    NotReady
        If fewer than two recordings can be evaluated.
    """
    named = unique_recording_names(recordings)
    _check_recordings(named, out)
    create_report_folder(out)
    runs, silent = list[NamedResult](), dict[str, str]()
    fitted_to = next(iter(named)) if model is None else None
    for at, (name, path) in enumerate(named.items(), start=1):
        notes = (
            (f"The model under test consists of the five noise terms of {fitted_to}.",) if fitted_to and at > 1 else ()
        )
        tell = _tell_for(report_progress, f"{name}, {at} of {len(named)}")
        try:
            result = reconcile_and_write_report(path, model, out / name, seed, loading, notes, tell, units)
        except NotReady as error:
            silent[name] = str(error)
            if model is None:
                break
            continue
        model = result.baseline
        runs.append(NamedResult(name, result))
    if len(runs) < 2:
        why = "; ".join(f"{name}: {said}" for name, said in silent.items())
        why = f"at least two recordings are needed for a comparison, but only {len(runs)} can be evaluated: {why}"
        _write(out / REPORT, _encode_failure(why, 0, COMPARISON_SCHEMA))
        raise NotReady(why)
    report_progress("writing", None)
    comparison = compare_results(runs, fitted_to, silent)
    _write_comparison(comparison, out, units)
    return comparison


def _write_comparison(result: RecordingsComparison, folder: Path, units: UnitSystem) -> None:
    from monitor.publishing.reports.reconcile_page import render_comparison_page

    _write(folder / REPORT, encode_comparison(result))
    _write(folder / "model.toml", result.model.to_toml().encode())
    _write(folder / "report.html", render_comparison_page(result, units).encode())


def unique_recording_names(recordings: Sequence[Path]) -> dict[str, Path]:
    """Return a unique name for each recording.

    The name is the file name without the suffix. A number is added if two file names are equal.

    Raises
    ------
    ConfigError
        If a recording is given twice.

    Examples
    --------
    >>> list(unique_recording_names([Path("a/run.csv"), Path("b/run.csv.gz"), Path("c/warm.npz")]))
    ['run', 'run-2', 'warm']
    """
    found: dict[str, Path] = {}
    for path in recordings:
        if real_path(path) in [real_path(other) for other in found.values()]:
            raise ConfigError(f"{path}: is given twice; a comparison needs different recordings")
        full = real_path(path).name
        suffix = next((one for one in FORMATS if full.lower().endswith(one)), "")
        stem = full[: len(full) - len(suffix)] or full
        possible = (stem, *(f"{stem}-{k}" for k in range(2, len(recordings) + 1)))
        found[next(name for name in possible if name not in found)] = path
    return found


def _check_recordings(named: Mapping[str, Path], out: Path) -> None:
    """Check that all recordings exist and that no report would overwrite a recording."""
    for path in named.values():
        if not path.exists():
            raise RecordingError(f"{path}: cannot be read: there is no such file or folder")
        if any(real_path(out / name) == real_path(path) for name in named):
            raise ConfigError(
                f"--out: {out}: {path} is a recording; choose a folder that contains no recording of the comparison"
            )


def _tell_for(tell: ProgressCallback, which: str) -> ProgressCallback:
    """Return a progress callback that adds the name of a recording to each message."""
    return lambda what, share: tell(f"{which}: {what}", share)


def write_report(result: Reconciliation, folder: Path, title: str, units: UnitSystem = DEFAULT_UNITS) -> None:
    """Write ``report.json``, ``model.toml``, ``report.html`` and, if an axis differs from the model, ``reconcile.rrd``.

    Without Rerun, ``reconcile.rrd`` is not written. The file of an earlier comparison is removed.

    Parameters
    ----------
    result : Reconciliation
        Result of the comparison of one recording with a noise model.
    folder : Path
        Existing folder of the report.
    title : str
        Title of the page ``report.html``.
    units : UnitSystem, optional
        Units of ``report.html`` and ``reconcile.rrd``.

    Raises
    ------
    ConfigError
        If a file cannot be written.
    """
    from monitor.publishing.reports.reconcile_page import render_page

    _write(folder / REPORT, encode_report(result))
    _write(folder / "model.toml", result.model.to_toml().encode())
    _write(folder / "report.html", render_page(result, title, units).encode())
    path = folder / "reconcile.rrd"
    path.unlink(missing_ok=True)
    if result.verdict == "agrees":  # the curves are in report.html, and there are no steps
        return
    try:
        from monitor.publishing.reports.reconcile_rrd import write_rrd
    except ImportError:  # the library of the viewer is optional
        return
    with atomic_write_path(path) as place:
        write_rrd(result, place, units)


def _encode_failure(why: str, samples: int, schema: str = SCHEMA) -> bytes:
    """Return the content of ``report.json`` for data that do not support an answer."""
    return msgspec.json.encode({"schema": schema, "verdict": None, "why": why, "samples": samples})


def create_report_folder(folder: Path) -> None:
    """Create the folder of the report.

    Raises
    ------
    ConfigError
        If the folder cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out: {folder}: cannot be created: {error.strerror}") from error


def _to_regular_grid(found: Samples) -> tuple[RecordedAxes, list[str]]:
    """Return the recording on a regular time grid, and notes about the resampling."""
    grid = place_samples_on_grid(list(iter_blocks(found)), found.rate_hz)
    columns = {axis: np.ascontiguousarray(grid.values[:, AXES.index(axis)], np.float64) for axis in found.axes}
    return RecordedAxes(columns, grid.rate_hz, grid.temperature_c), grid.notes_with_missing()


def _write(path: Path, data: bytes) -> None:
    with atomic_write_path(path) as place:
        place.write_bytes(data)
