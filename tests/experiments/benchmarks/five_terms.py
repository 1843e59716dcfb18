"""Names that ``analyze`` gives by itself: the five-term fit and its notes, without a model to compare with.

A coefficient that is estimated where the model has no such term is a name; so are a line and a resonance that the
model has not, outliers, a low-pass, values in coarse steps, a bias that stepped and white noise of another level: each
is what one of the notes says. Notes of a misfit name nothing. Of one axis each name is given once.
"""

from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

from drivers.data_types import AXES, Floats, make_block
from monitor.estimation.analysis import DETECTOR_CHUNK_ROWS, RecordingAnalysis, analyze
from monitor.estimation.analysis_notes import LINE_FREQUENCY_TOLERANCE, MIN_OUTLIER_SHARE
from monitor.estimation.detection.change_detection import Change, NoiseAndBiasChangeDetector
from monitor.estimation.detection.coarse_quantization import find_coarsely_quantized_axes
from monitor.estimation.detection.line_and_outlier_detection import (
    SpectralLine,
    detect_spectral_lines_per_axis,
    outlier_share_of_axes,
)
from monitor.estimation.detection.motion_detection import detect_motion
from monitor.estimation.fit.coefficient_values import SYMBOLS, Status
from monitor.noise.effects import Narrowband, Sinusoidal
from monitor.noise.model import NoiseModel

EFFECTS: Final = dict(
    zip(
        SYMBOLS,
        ("quantization_noise", "angle_random_walk", "bias_instability", "rate_random_walk", "rate_ramp"),
        strict=True,
    )
)
SAID: Final = frozenset(
    {
        *EFFECTS.values(),
        "sinusoidal",
        "narrowband",
        "outliers",
        "bandwidth_limit",
        "resolution",
        "bias_step",
        "noise_step",
    }
)
"""All names that it can give."""


def names(columns: Mapping[str, Floats], rate_hz: float, model: NoiseModel) -> set[tuple[str, str]]:
    """(axis, effect) of what ``analyze`` says of a recording beyond a model.

    Args:
        columns: axis -> [n] SI; an axis that is not there is not judged
        rate_hz: stated
        model: whose terms and lines are no names
    """
    n = next(iter(columns.values())).size
    values = np.stack([columns.get(axis, np.full(n, np.nan)) for axis in AXES], axis=1)
    t_ns = np.rint(np.arange(n) * (1e9 / rate_hz)).astype(np.int64)
    result = analyze([make_block(t_ns, values)], rate_hz)
    said = (*_of_fit(result, model), *_of_events(result, model))
    return {(axis, name) for axis, name in said if axis in columns}


def _of_fit(result: RecordingAnalysis, model: NoiseModel) -> Iterator[tuple[str, str]]:
    has = {axis: {effect.name for effect in model.effects.get(axis, ())} for axis in AXES}
    status = result.estimate.coefficients.status
    for i, axis in enumerate(AXES):
        for letter, effect in EFFECTS.items():
            if status[SYMBOLS.index(letter), i] == Status.ESTIMATED and effect not in has[axis]:
                yield axis, effect
        if np.isfinite(result.bandwidth_hz[i]) and "bandwidth_limit" not in has[axis]:
            yield axis, "bandwidth_limit"
    for one in find_coarsely_quantized_axes(result.values):
        yield AXES[one.axis], "resolution"


def _of_events(result: RecordingAnalysis, model: NoiseModel) -> Iterator[tuple[str, str]]:
    """Of what ``detect_disturbances`` looks for, where it stands as numbers: each thing is sought once, as there."""
    values, rate_hz = result.values, result.estimate.rate_hz
    moving, _ = detect_motion(values, rate_hz)
    for line in detect_spectral_lines_per_axis(values, moving, rate_hz, result.estimate.curve):
        if not _expected(line, model):
            yield AXES[line.axis], "narrowband" if line.wide else "sinusoidal"
    for i in np.flatnonzero(outlier_share_of_axes(values, moving) > MIN_OUTLIER_SHARE).tolist():
        yield AXES[i], "outliers"
    detector = NoiseAndBiasChangeDetector(rate_hz)
    for begin in range(0, len(values), DETECTOR_CHUNK_ROWS):
        rows = slice(begin, begin + DETECTOR_CHUNK_ROWS)
        detector.process_samples(np.where(moving[rows, None], np.nan, values[rows]))
    for change in detector.take_changes():
        name = _of_change(change)
        if name:
            yield AXES[change.axis], name


def _of_change(change: Change) -> str | None:
    """What a change is called; noise that changed elsewhere than in white noise has no name."""
    if change.kind == "noise_changed":
        return "noise_step" if "N" in change.what else None
    return {"bias_stepped": "bias_step", "outlier_burst": "outliers"}[change.kind]


def _expected(line: SpectralLine, model: NoiseModel) -> bool:
    """Whether the model has a line or a resonance there."""
    for effect in model.effects.get(AXES[line.axis], ()):
        if (
            isinstance(effect, Sinusoidal)
            and abs(line.frequency_hz / effect.frequency - 1.0) < LINE_FREQUENCY_TOLERANCE
        ):
            return True
        if isinstance(effect, Narrowband) and abs(line.frequency_hz - effect.frequency) < 2.0 * effect.bandwidth:
            return True
    return False
