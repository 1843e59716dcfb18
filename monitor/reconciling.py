"""The work of ``imu-monitor reconcile``: a recording from its file, the comparison in threads, and the folder it
leaves.

``DIR/`` gets ``report.html``, ``report.json``, ``model.toml`` and ``reconcile.rrd``; each appears whole or not at all.
Where the data do not support an answer there is ``report.json`` alone, and it says why. Kernels and transforms run
without the GIL, so that axes and simulated recordings are looked at side by side.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from drivers.errors import ConfigError, NotReady
from drivers.recording import Recording as Samples
from drivers.recording import iter_blocks, load_samples
from drivers.recording.saving import whole
from drivers.sample import AXES
from monitor.estimate.grid import with_temperature
from monitor.noise.model import NoiseModel
from monitor.reconcile.reconcile import Recording, reconcile
from monitor.reconcile.reconciliation import Reconciliation
from monitor.reconcile.report import SCHEMA, to_json

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


def make(request: Request, tell: Tell = lambda _what, _share: None) -> Reconciliation:
    """Read, compare, and write the folder.

    Raises:
        RecordingError, ConfigError: no recording, or a folder that cannot be written
        NotReady: the data do not support an answer; the folder says why
    """
    check_folder(request.out)
    tell("reading", None)
    found = load_samples(request.recording, request.rate_hz)
    try:
        recording, notes = _recording(found)
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            result = reconcile(recording, request.model, request.seed, pool.map, lambda what: tell(what, None))
    except NotReady as error:
        _write(request.out / REPORT, no_answer(str(error), len(found)))
        raise
    result = replace(result, notes=(*found.notes, *notes, *result.notes))
    tell("writing", None)
    write(result, request.out, request.recording.name)
    return result


def write(result: Reconciliation, folder: Path, title: str) -> None:
    """All four files."""
    from monitor.publish.reconcile_page import page

    _write(folder / REPORT, to_json(result))
    _write(folder / "model.toml", result.model.to_toml().encode())
    _write(folder / "report.html", page(result, title).encode())
    try:
        from monitor.publish.reconcile_rrd import write_rrd
    except ImportError:  # the viewer's library is optional
        return
    with whole(folder / "reconcile.rrd") as place:
        write_rrd(result, place)


def no_answer(why: str, samples: int) -> bytes:
    """``report.json`` where there is no verdict."""
    return msgspec.json.encode({"schema": SCHEMA, "verdict": None, "why": why, "samples": samples})


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
