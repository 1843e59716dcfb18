"""Export of noise coefficients for simulators: gnss-ins-sim in Python, and MathWorks ``imuSensor`` in MATLAB.

The class ``imu_model.IMU`` of gnss-ins-sim reads angle random walk in °/√h, bias stability of gyroscopes in °/h,
velocity random walk in m/s/√h and bias stability of accelerometers in m/s². The simulator has no flicker noise. The
bias is a first-order Gauss-Markov process with a standard deviation (``b_stability``) and a correlation time
(``b_corr``), which are chosen as for the Kalman filter in ``monitor.publishing.exporters.kalman``. With an infinite
correlation time, the simulator draws white noise instead, so that such a bias is exported with a stability of 0.

The property ``NoiseDensity`` of ``imuSensor`` is N of IEEE Std 952 if the noise type is ``single-sided``, because the
standard deviation of a sample is then NoiseDensity·√rate. With the default noise type of MathWorks, the noise would be
too small by a factor of √2. The property ``BiasInstability`` is the standard deviation of the white noise at the input
of a filter. With the filter ``fractalcoef`` (Kasdin, Proc. IEEE 83(5), 1995), the bias has the spectrum B²/(2πf) of
IEEE Std 952. The default filter of MathWorks has one pole at 0.5 and does not generate flicker noise.

If only an upper bound of a coefficient is known, the coefficient is set to 0, because the values are meant for
simulation.
"""

from collections.abc import Mapping, Sequence
from typing import Final

from drivers.number_ranges import HOUR_S
from monitor.common.unit_formatting import DEGREE, ROOT_HOUR, Kind, axes_of
from monitor.publishing.exporters.export_input import (
    AxisCoefficientOrBound,
    NoiseCoefficients,
    ascii_unit,
    comment_on_omitted_terms,
    describe_coefficients,
    format_float,
    header_comments,
    join_lines,
)
from monitor.publishing.exporters.kalman import markov_sigma, markov_time_s

KINDS_IN_DICTIONARY: Final[tuple[tuple[Kind, str, float, str, float, str], ...]] = (
    ("gyro", "arw", DEGREE * ROOT_HOUR, "deg/sqrt(hr)", DEGREE * HOUR_S, "deg/hr"),
    ("accel", "vrw", ROOT_HOUR, "m/s/sqrt(hr)", 1.0, "m/s^2"),
)
"""Kind of sensor, then key, factor and unit of the random walk, and factor and unit of the bias."""


def export_gnss_ins_sim(
    noise: NoiseCoefficients, inflation: float = 1.0, correlation_time_s: float | None = None
) -> str:
    """Return the Python code of the dictionary ``imu_err``.

    Parameters
    ----------
    noise
        Noise coefficients of each axis, in SI units.
    inflation
        Factor that multiplies N and B.
    correlation_time_s
        Correlation time of the bias [s]. By default, the time is computed from N and K.
    """
    lines = [
        "# imu_err for imu_model.IMU(accuracy=imu_err) of gnss-ins-sim",
        *header_comments(noise, inflation, "#"),
        "# b_stability: standard deviation of a Gauss-Markov process whose Allan deviation has the peak value 0.664 B",
        "# K sets only the correlation time of this process: the simulator has no random walk of the bias",
        "import numpy as np",
        "",
        "imu_err = {",
    ]
    for kind, walk, walk_factor, walk_unit, bias_factor, bias_unit in KINDS_IN_DICTIONARY:
        by_axis = {axis: noise.axes.get(axis, {}) for axis in axes_of(kind)}
        markov = [_markov_process(terms, inflation, correlation_time_s) for terms in by_axis.values()]
        walks = [_estimate(terms, "N") * inflation * walk_factor for terms in by_axis.values()]
        lines += [
            *(f"    # {axis}: {describe_coefficients(terms, 'NBK')}" for axis, terms in by_axis.items()),
            _item(f"{kind}_b", [0.0] * 3, bias_unit),
            _item(f"{kind}_{walk}", walks, walk_unit),
            _item(f"{kind}_b_stability", [sigma * bias_factor for sigma, _ in markov], bias_unit),
            _item(f"{kind}_b_corr", [time_s for _, time_s in markov], "s"),
        ]
    return join_lines([*lines, "}", *comment_on_omitted_terms(noise, "NB", "#")])


def _estimate(terms: Mapping[str, AxisCoefficientOrBound], letter: str) -> float:
    """Return an estimate, or 0 if the coefficient is unknown or only bounded."""
    return terms[letter].value if letter in terms and not terms[letter].bound else 0.0


def _markov_process(
    terms: Mapping[str, AxisCoefficientOrBound], inflation: float, correlation_time_s: float | None
) -> tuple[float, float]:
    """Return the standard deviation and the correlation time [s] of the bias, or 0 and infinity."""
    N, B, K = (_estimate(terms, letter) for letter in "NBK")
    time_s = correlation_time_s or (markov_time_s(N, K) if N and K else None)
    return (markov_sigma(B) * inflation, time_s) if B and time_s is not None else (0.0, float("inf"))


def _item(key: str, values: Sequence[float], unit: str) -> str:
    listed = ", ".join("np.inf" if value == float("inf") else format_float(value) for value in values)
    return f"    '{key}': np.array([{listed}]),  # {unit}"


N_POLES: Final = 500
"""Number of poles of the 1/f filter, the same as in the Allan variance example of MathWorks."""


def export_gyroparams(noise: NoiseCoefficients, inflation: float = 1.0) -> str:
    """Export noise coefficients as a MATLAB script.

    Parameters
    ----------
    noise
        Noise coefficients of each axis, in SI units.
    inflation
        Factor that multiplies N, B and K.
    """
    lines = [
        "% Noise of an IMU for imuSensor (Navigation Toolbox, or Sensor Fusion and Tracking Toolbox), R2023b or newer",
        *header_comments(noise, inflation, "%"),
        "% single-sided: white noise with sigma = NoiseDensity*sqrt(rate) per sample, N of IEEE Std 952",
        f"% fractalcoef({N_POLES}): 1/f noise down to about rate/{N_POLES}; more poles extend the range",
    ]
    made = []
    kinds: tuple[tuple[Kind, str, str], ...] = (
        ("gyro", "gyroparams", "Gyroscope"),
        ("accel", "accelparams", "Accelerometer"),
    )
    for kind, maker, name in kinds:
        if not set(axes_of(kind)) & noise.axes.keys():
            continue
        unit = ascii_unit("B", kind)
        made.append(f", '{name}', {kind}")
        lines += [
            "",
            *(
                f"% {axis}: {describe_coefficients(noise.axes[axis], 'NBK')}"
                for axis in axes_of(kind)
                if axis in noise.axes
            ),
            f"{kind} = {maker}( ...",
            _property(noise, kind, "N", "NoiseDensity", f"({unit})/sqrt(Hz)", inflation),
            _property(noise, kind, "B", "BiasInstability", unit, inflation),
            _property(noise, kind, "K", "RandomWalk", f"({unit})*sqrt(Hz)", inflation),
            "    'NoiseType', 'single-sided', ...",
            f"    'BiasInstabilityCoefficients', fractalcoef({N_POLES}));",
        ]
    rate = "" if noise.sample_rate_hz is None else f", 'SampleRate', {noise.sample_rate_hz!r}"
    lines += ["", f"imu = imuSensor('accel-gyro'{rate}{''.join(made)});"]
    return join_lines([*lines, *comment_on_omitted_terms(noise, "NBK", "%")])


def _property(noise: NoiseCoefficients, kind: Kind, letter: str, name: str, unit: str, inflation: float) -> str:
    """Return a property with the values of three axes. Unknown coefficients are written as 0, with a comment."""
    known, values, said = noise.coefficient_by_axis(kind, letter), [], ""
    for axis in axes_of(kind):
        term = known.get(axis)
        values.append("0" if term is None or term.bound else format_float(term.value * inflation))
        if term is None:
            said += f"; {axis} unknown"
        elif term.bound:
            said += f"; {axis} only bounded, <= {term.value:.3g}"
    return f"    '{name}', [{' '.join(values)}], ... % {letter}, {unit}{said}"
