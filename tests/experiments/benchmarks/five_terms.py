"""Names of effects from ``analyze``, which are its five-term fit and its notes, without a comparison with a model.

An estimated coefficient is a name if the model has no such term. The notes give further names: a line or a resonance
that the model does not contain, outliers, a low-pass, a coarse resolution, a bias step, and a change of the white
noise. Notes of a poor fit are no names. Each name occurs once for each axis.
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
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Status
from monitor.noise.effects import Narrowband, Sinusoidal
from monitor.noise.model import NoiseModel

EFFECTS: Final = dict(
    zip(
        SYMBOLS,
        ("quantization_noise", "angle_random_walk", "bias_instability", "rate_random_walk", "rate_ramp"),
        strict=True,
    )
)
POSSIBLE_NAMES: Final = frozenset(
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
"""All names that ``analyze`` can give."""


def find_names(columns: Mapping[str, Floats], rate_hz: float, model: NoiseModel) -> set[tuple[str, str]]:
    """Return (axis, effect) for each effect that ``analyze`` finds and a model does not contain.

    Parameters
    ----------
    columns
        Samples [n] of each axis in SI units.
    rate_hz
        Stated sample rate in Hz.
    model
        Model with the known terms and lines.
    """
    n = next(iter(columns.values())).size
    values = np.stack([columns.get(axis, np.full(n, np.nan)) for axis in AXES], axis=1)
    t_ns = np.rint(np.arange(n) * (1e9 / rate_hz)).astype(np.int64)
    result = analyze([make_block(t_ns, values)], rate_hz)
    pairs = (*_names_of_fit(result, model), *_names_of_disturbances(result, model))
    return {(axis, name) for axis, name in pairs if axis in columns}


def _names_of_fit(result: RecordingAnalysis, model: NoiseModel) -> Iterator[tuple[str, str]]:
    has = {axis: {effect.name for effect in model.effects.get(axis, ())} for axis in AXES}
    status = result.estimate.coefficients.status
    for i, axis in enumerate(AXES):
        for letter, effect in EFFECTS.items():
            if status[SYMBOLS.index(letter), i] == Status.ESTIMATED and effect not in has[axis]:
                yield axis, effect
        if np.isfinite(result.bandwidth_hz[i]) and "bandwidth_limit" not in has[axis]:
            yield axis, "bandwidth_limit"
    for finding in find_coarsely_quantized_axes(result.values):
        yield AXES[finding.axis], "resolution"


def _names_of_disturbances(result: RecordingAnalysis, model: NoiseModel) -> Iterator[tuple[str, str]]:
    """Yield the names of lines, outliers and changes, which are detected as in ``detect_disturbances``."""
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
        name = _name_of_change(change)
        if name:
            yield AXES[change.axis], name


def _name_of_change(change: Change) -> str | None:
    """Return the name of a change, or None for a change of noise without a change of white noise."""
    if change.kind == "noise_changed":
        return "noise_step" if "N" in change.what else None
    return {"bias_stepped": "bias_step", "outlier_burst": "outliers"}[change.kind]


def _expected(line: SpectralLine, model: NoiseModel) -> bool:
    """Return True if the model has a line or resonance at this frequency."""
    for effect in model.effects.get(AXES[line.axis], ()):
        if (
            isinstance(effect, Sinusoidal)
            and abs(line.frequency_hz / effect.frequency - 1.0) < LINE_FREQUENCY_TOLERANCE
        ):
            return True
        if isinstance(effect, Narrowband) and abs(line.frequency_hz - effect.frequency) < 2.0 * effect.bandwidth:
            return True
    return False
