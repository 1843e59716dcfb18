"""Export of noise coefficients as parameter files of other programs.

Each exporter returns the text of a file that states units, the source of the coefficients and the inflation factor. The
coefficient N of IEEE Std 952 in rad/√s equals the two-sided density of white noise in rad/s/√Hz. The coefficient K in
rad/s/√s equals the density, in rad/s²/√Hz, of the white noise that drives the bias.

The inflation factor multiplies N, B and K, because a sensor on a vehicle has more noise than a sensor at rest. If only
an upper bound of a coefficient is known, exporters for filters use the bound as the value and add a comment. The
exporters for simulation ignore upper bounds. The text is ASCII, because some target programs require ASCII.
"""

from collections.abc import Callable
from typing import Any, Final, NamedTuple

from drivers.errors import ConfigError
from drivers.validation.number_ranges import COEFFICIENT, DURATION_S, INFLATION
from monitor.publishing.exporters.estimator_parameters import PARAMETER_FILES
from monitor.publishing.exporters.export_input import (
    AxisCoefficientOrBound,
    NoiseCoefficients,
    describe_weak_points,
    from_analysis_json,
    from_model,
    join_sources,
    missing_coefficient_error,
)
from monitor.publishing.exporters.imu_utils import export_imu_utils
from monitor.publishing.exporters.kalman import export_kalman_process_noise
from monitor.publishing.exporters.simulator_parameters import export_gnss_ins_sim, export_gyroparams

__all__ = [
    "FORMATS",
    "AxisCoefficientOrBound",
    "NoiseCoefficients",
    "describe_weak_points",
    "export",
    "from_analysis_json",
    "from_model",
    "join_sources",
]


class Exporter(NamedTuple):
    """Function that exports noise coefficients, and the names of its options."""

    write: Callable[..., str]
    options: frozenset[str]


FORMATS: Final[dict[str, Exporter]] = {
    **{one.name: Exporter(one.export, one.options) for one in PARAMETER_FILES},
    "imu_utils": Exporter(export_imu_utils, frozenset({"dt_s"})),
    "gnss_ins_sim": Exporter(export_gnss_ins_sim, frozenset({"correlation_time_s"})),
    "gyroparams": Exporter(export_gyroparams, frozenset()),
    "kalman": Exporter(export_kalman_process_noise, frozenset({"dt_s", "correlation_time_s"})),
}
"""Exporters by file format."""


def export(noise: NoiseCoefficients, format_name: str, inflation: float = 1.0, **options: Any) -> str:
    """Export noise coefficients as the text of a parameter file.

    Parameters
    ----------
    noise
        Noise coefficients that ``from_model`` or ``from_analysis_json`` returned.
    format_name
        Name of the file format, a key of FORMATS.
    inflation
        Factor that multiplies N, B and K, at least 1.
    options
        Options of the file format, whose names ``FORMATS`` lists. None means that an option is not given.

    Raises
    ------
    ConfigError
        If the format is unknown, an option does not belong to the format, the inflation factor is below 1, or the noise
        model lacks a required coefficient.
    NotReady
        If the recording determines none of the required coefficients.
    """
    if format_name not in FORMATS:
        raise ConfigError(f'unknown format "{format_name}"; possible are {", ".join(FORMATS)}')
    given = {name: value for name, value in options.items() if value is not None}
    for name in given:
        formats = [one for one, exporter in FORMATS.items() if name in exporter.options]
        if format_name not in formats:
            raise ConfigError(f"{name}: is an option of {', '.join(formats)}, not of {format_name}")
    checked = (("inflation", INFLATION, inflation), ("correlation time", DURATION_S, given.get("correlation_time_s")))
    for name, allowed_range, value in checked:
        try:
            if value is not None:
                allowed_range.check(value)
        except ConfigError as error:
            raise ConfigError(f"{name}: {error}") from None
    if not noise.axes:
        raise missing_coefficient_error(noise, "nothing to export: no axis has any of Q, N, B, K, R")
    for axis, terms in noise.axes.items():
        for letter, term in terms.items():
            if term.value and not COEFFICIENT.supports(term.value):
                raise ConfigError(f"{axis}: {letter} = {term.value:g}; no sensor has that")
    return FORMATS[format_name].write(noise, inflation, **given)
