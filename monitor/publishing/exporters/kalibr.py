"""Export of noise coefficients as ``imu.yaml`` of Kalibr, with continuous-time noise densities.

The file contains one value for each kind of sensor, which is the largest value of the three axes. Keys and units follow
the pages "YAML formats" and "IMU Noise Model" in the Kalibr wiki. Kalibr multiplies the white-noise density by 1/√Δt
and the random-walk density by √Δt, so these densities are N and K of IEEE Std 952. Kalibr rejects a density of zero, so
a missing coefficient is an error. If all axes have only upper bounds, the largest bound is exported with a comment.
"""

from typing import Final

from drivers.errors import ConfigError
from monitor.common.unit_formatting import Kind
from monitor.publishing.exporters.exported_coefficients import (
    COEFFICIENT_EFFECTS,
    AxisCoefficientOrBound,
    NoiseCoefficients,
    ascii_unit,
    comment_on_omitted_terms,
    format_float,
    header_comments,
    join_lines,
    missing_coefficient_error,
)

INFLATION_COMMENT: Final = (
    "# Kalibr's wiki, IMU Noise Model: a sensor at rest at constant temperature has less noise; for the",
    "# lowest-cost sensors it may be necessary to raise these values by a factor of 10 or more (--inflation 10)",
)


def export_kalibr(noise: NoiseCoefficients, inflation: float = 1.0, rostopic: str = "/imu0") -> str:
    """Return the text of ``imu.yaml`` with the noise densities of gyroscopes and accelerometers.

    Parameters
    ----------
    noise
        Noise coefficients of each axis, in SI units.
    inflation
        Factor that multiplies the noise densities.
    rostopic
        ROS topic on which the IMU publishes.

    Raises
    ------
    ConfigError
        If the noise model has no sample rate, or lacks N or K for one kind of sensor.
    NotReady
        If the recording is too short to determine N or K.
    """
    if noise.sample_rate_hz is None:
        raise ConfigError("kalibr needs an update_rate, and the model has no sample_rate")
    lines = [
        "# imu.yaml for Kalibr: continuous-time noise; one value for each kind of sensor, from the worst axis",
        *header_comments(noise, inflation, "#"),
        *INFLATION_COMMENT,
        f"rostopic: {rostopic}",
        f"update_rate: {noise.sample_rate_hz!r}  # Hz",
    ]
    kinds: tuple[tuple[Kind, str], ...] = (("accel", "accelerometer"), ("gyro", "gyroscope"))
    for kind, name in kinds:
        for letter, key, unit_of in (("N", "noise_density", "B"), ("K", "random_walk", "R")):
            largest, comment = _largest_term(noise, kind, letter)
            unit = f"{ascii_unit(unit_of, kind)}/sqrt(Hz)"  # a density has the unit of B (for N) or R (for K) per √Hz
            lines += [f"# {letter}: {comment}", f"{name}_{key}: {format_float(largest.value * inflation)}  # {unit}"]
    return join_lines([*lines, *comment_on_omitted_terms(noise, "NK", "#")])


def _largest_term(noise: NoiseCoefficients, kind: Kind, letter: str) -> tuple[AxisCoefficientOrBound, str]:
    """Return the largest estimate of three axes, or the largest upper bound if there is no estimate."""
    known = noise.coefficient_by_axis(kind, letter)
    if not known:
        raise missing_coefficient_error(
            noise, f"kalibr needs {letter} ({COEFFICIENT_EFFECTS[letter].name}) above 0 on the {kind} axes"
        )
    rank = {axis: (not term.bound, term.value) for axis, term in known.items()}
    axis = max(rank, key=lambda one: rank[one])
    listed = ", ".join(f"{one} {'<= ' if term.bound else ''}{term.value:.3g}" for one, term in known.items())
    only = ", UPPER BOUND instead of a value" if known[axis].bound else ""
    alike = len(known) > 1 and len(set(rank.values())) == 1
    return known[axis], f"{'all axes alike' if alike else f'worst axis {axis}'}{only} ({listed})"
