"""Noise parameters for other tools: Kalibr's imu.yaml, MATLAB's gyroparams and accelparams, a Kalman filter's Q.

In comes a ``Noise``, what is known of each axis, from a model file or from ``analyze --json``; out goes the text of a
file that states its units, the source of its numbers and the inflation it used. No factor is hidden: IEEE Std 952's N
in rad/√s is the two-sided density of white noise in rad/s/√Hz, its K in rad/s/√s that of the white noise which drives
the bias, rad/s²/√Hz.

Inflation multiplies N, B and K: a sensor at rest at one temperature shows less than the same sensor on a vehicle. An
upper bound is used by the filters' formats, with a comment, and never by the simulator's. What a format has no place
for is named in a comment. Texts are ASCII, as some of those who read them want it.
"""

from collections.abc import Callable
from typing import Any, Final

from drivers.errors import ConfigError
from drivers.quantities import COEFFICIENT, INFLATION
from monitor.publishing.exporters.gyroparams import gyroparams
from monitor.publishing.exporters.kalibr import kalibr
from monitor.publishing.exporters.kalman import kalman
from monitor.publishing.exporters.noise import Noise, Term, from_analysis, from_model, lacking

__all__ = ["FORMATS", "Noise", "Term", "export", "from_analysis", "from_model"]

FORMATS: Final[dict[str, Callable[..., str]]] = {"kalibr": kalibr, "gyroparams": gyroparams, "kalman": kalman}


def export(noise: Noise, form: str, inflation: float = 1.0, **options: Any) -> str:
    """The text of one format.

    Args:
        noise: from ``from_model`` or ``from_analysis``
        form: a name of FORMATS
        inflation: factor on N, B and K, 1 or more
        options: of that format: ``kalibr`` rostopic; ``kalman`` dt_s, correlation_time_s
    Raises:
        ConfigError: unknown format, an inflation below 1, or the model lacks what the format needs
        NotReady: the analysed recording did not show what the format needs
    """
    if form not in FORMATS:
        raise ConfigError(f'unknown format "{form}"; possible are {", ".join(FORMATS)}')
    try:
        INFLATION.check(inflation)
    except ConfigError as error:
        raise ConfigError(f"inflation: {error}") from None
    if not noise.axes:
        raise lacking(noise, "nothing to export: no axis has any of Q, N, B, K, R")
    for axis, terms in noise.axes.items():
        for letter, term in terms.items():
            if term.value and not COEFFICIENT.supports(term.value):
                raise ConfigError(f"{axis}: {letter} = {term.value:g}; no sensor has that")
    return FORMATS[form](noise, inflation, **options)
