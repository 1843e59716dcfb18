"""Export of noise parameters for other tools: Kalibr, MATLAB (gyroparams and accelparams) and Kalman filters.

The input is a ``NoiseCoefficients`` object, from a model file or from ``analyze --json``. The output is the text of a
file that states units, the source of the numbers and the inflation factor. No other factor is applied. N of IEEE Std
952 in rad/√s equals the two-sided density of white noise in rad/s/√Hz. K in rad/s/√s equals the density of the white
noise that drives the bias, in rad/s²/√Hz.

The inflation factor multiplies N, B and K, because a sensor at rest at constant temperature has less noise than the
same sensor on a vehicle. The formats for filters use an upper bound as if it were a value, with a comment. The format
for simulation ignores upper bounds. Comments name the terms that a format cannot represent. All text is ASCII, because
some of the target programs require it.
"""

from collections.abc import Callable
from typing import Any, Final

from drivers.errors import ConfigError
from drivers.number_ranges import COEFFICIENT, INFLATION
from monitor.publishing.exporters.exported_coefficients import (
    ExportedCoefficient,
    NoiseCoefficients,
    from_analysis_json,
    from_model,
    missing_coefficient_error,
)
from monitor.publishing.exporters.gyroparams import export_gyroparams
from monitor.publishing.exporters.kalibr import export_kalibr
from monitor.publishing.exporters.kalman import export_kalman

__all__ = ["FORMATS", "ExportedCoefficient", "NoiseCoefficients", "export", "from_analysis_json", "from_model"]

FORMATS: Final[dict[str, Callable[..., str]]] = {
    "kalibr": export_kalibr,
    "gyroparams": export_gyroparams,
    "kalman": export_kalman,
}
"""Export function of each format."""


def export(noise: NoiseCoefficients, format_name: str, inflation: float = 1.0, **options: Any) -> str:
    """Return the text of a parameter file.

    Parameters
    ----------
    noise
        Coefficients from ``from_model`` or ``from_analysis_json``.
    format_name
        Name of the format, a key of FORMATS.
    inflation
        Factor on N, B and K, at least 1.
    options
        Options of the format: rostopic for ``kalibr``; dt_s and correlation_time_s for ``kalman``.

    Raises
    ------
    ConfigError
        If the format is unknown, the inflation is below 1, or the model lacks a coefficient that the format needs.
    NotReady
        If the analysed recording does not determine a coefficient that the format needs.
    """
    if format_name not in FORMATS:
        raise ConfigError(f'unknown format "{format_name}"; possible are {", ".join(FORMATS)}')
    try:
        INFLATION.check(inflation)
    except ConfigError as error:
        raise ConfigError(f"inflation: {error}") from None
    if not noise.axes:
        raise missing_coefficient_error(noise, "nothing to export: no axis has any of Q, N, B, K, R")
    for axis, terms in noise.axes.items():
        for letter, term in terms.items():
            if term.value and not COEFFICIENT.supports(term.value):
                raise ConfigError(f"{axis}: {letter} = {term.value:g}; no sensor has that")
    return FORMATS[format_name](noise, inflation, **options)
