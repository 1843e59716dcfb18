"""Export of noise coefficients as a MATLAB script for the MathWorks model ``imuSensor``.

The property ``NoiseDensity`` is N of IEEE Std 952 if the noise type is ``single-sided``, because the standard deviation
of a sample is then NoiseDensity·√rate. With the default noise type of MathWorks, the noise would be too small by a
factor of √2. The property ``BiasInstability`` is the standard deviation of the white noise at the input of a filter.
With the filter ``fractalcoef`` (Kasdin, Proc. IEEE 83(5), 1995), the bias has the spectrum B²/(2πf) of IEEE Std 952.
The default filter of MathWorks has one pole at 0.5 and does not generate flicker noise.

If only an upper bound of a coefficient is known, the coefficient is set to 0, because the script is meant for
simulation.
"""

from typing import Final

from monitor.common.unit_formatting import Kind, axes_of
from monitor.publishing.exporters.export_input import (
    NoiseCoefficients,
    ascii_unit,
    comment_on_omitted_terms,
    describe_coefficients,
    format_float,
    header_comments,
    join_lines,
)

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
