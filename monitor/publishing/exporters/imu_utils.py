"""Export of noise coefficients as the result file of imu_utils.

The file has the format that imu_utils itself writes (class FitAllanGyr). The README of imu_utils differs from it.
``gyr_n`` and ``acc_n`` are standard deviations of a sample, N/√dt. ``gyr_w`` and ``acc_w`` are the minimum of the
fitted Allan deviation, which the program calls bias instability. The Allan variance of N, B and K is

    σ²(τ) = N²/τ + (2 ln 2/π) B² + K² τ/3  (IEEE Std 952)

and its minimum is (2 ln 2/π) B² + 2 N K/√3, at τ = √3 N/K.
"""

import math
from collections.abc import Mapping
from typing import Final

from monitor.common.unit_formatting import Kind
from monitor.publishing.exporters.export_input import (
    AxisCoefficientOrBound,
    NoiseCoefficients,
    choose_time_step_s,
    comment_on_omitted_terms,
    describe_coefficients,
    format_float,
    header_comments,
    join_lines,
    missing_coefficient_error,
)

KINDS_IN_FILE: Final[tuple[tuple[Kind, str, str, str], ...]] = (
    ("gyro", "Gyr", "gyr", " rad/s"),
    ("accel", "Acc", "acc", " m/s^2"),
)


def export_imu_utils(noise: NoiseCoefficients, inflation: float = 1.0, dt_s: float | None = None) -> str:
    """Return the text of the result file of imu_utils, with the average of the axes and the values of each axis.

    Parameters
    ----------
    noise
        Noise coefficients of each axis, in SI units.
    inflation
        Factor that multiplies N, B and K.
    dt_s
        Sample period [s]. By default, the sample period of the noise model or recording.

    Raises
    ------
    ConfigError
        If the sample rate is unknown, or if the noise model lacks N, or both B and K, on all axes of a kind.
    NotReady
        If the recording determines N, and B or K, on no axis.
    """
    step_s = choose_time_step_s(noise, dt_s, "imu_utils")
    lines = [
        "%YAML:1.0",
        "---",
        "# result file of imu_utils",
        *header_comments(noise, inflation, "#"),
        f"# _n = N/sqrt(dt), standard deviation of one sample, dt = {step_s:g} s ({1.0 / step_s:g} Hz)",
        "# _w = minimum of the Allan deviation, sqrt(0.4413 B^2 + 2 N K/sqrt(3)); this is not the random walk K",
        "type: IMU",
        "name: imu",
    ]
    known = {
        kind: {
            axis: noise.axes[axis]
            for axis in noise.coefficient_by_axis(kind, "N")
            if {"B", "K"} & noise.axes[axis].keys()
        }
        for kind, *_ in KINDS_IN_FILE
    }
    for kind, title, prefix, unit in KINDS_IN_FILE:
        by_axis = known[kind]
        if not by_axis and noise.measured and any(known.values()):
            lines.append(f"# {title} is left out: N, and B or K, of the {kind} axes are not measured")
            continue
        if not by_axis:
            raise missing_coefficient_error(noise, f"imu_utils needs N and B or K above 0 on the {kind} axes")
        values = {axis: _white_noise_and_minimum(terms, inflation, step_s) for axis, terms in by_axis.items()}
        average = tuple(sum(column) / len(values) for column in zip(*values.values(), strict=True))
        lines += [f"{title}:", f'   unit: "{unit}"', f"   # average of {', '.join(values)}"]
        lines += _block("avg", prefix, average)
        for axis, pair in values.items():
            lines.append(f"   # {axis}: {describe_coefficients(by_axis[axis], 'NBK')}")
            lines += _block(axis[1], prefix, pair)
    return join_lines([*lines, *comment_on_omitted_terms(noise, "NBK", "#")])


def _white_noise_and_minimum(
    terms: Mapping[str, AxisCoefficientOrBound], inflation: float, dt_s: float
) -> tuple[float, float]:
    """Return the standard deviation of a sample, and the minimum of the Allan deviation of N, B and K."""
    N, B, K = (terms[letter].value * inflation if letter in terms else 0.0 for letter in "NBK")
    return N / math.sqrt(dt_s), math.sqrt(2.0 * math.log(2.0) / math.pi * B**2 + 2.0 * N * K / math.sqrt(3.0))


def _block(name: str, prefix: str, values: tuple[float, ...]) -> list[str]:
    return [
        f"   {name}-axis:",
        f"      {prefix}_n: {format_float(values[0])}",
        f"      {prefix}_w: {format_float(values[1])}",
    ]
