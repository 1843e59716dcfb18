"""Export of N and K as parameter files of state estimators and calibration programs.

Each program reads one value of N and one value of K for each kind of sensor, so the value of the worst axis is
exported. The programs differ in file syntax and parameter names. They state the noise in one of these forms:

- a continuous-time density, which the program converts to its own time step,
- the square of the density, as a covariance in continuous time,
- the standard deviation of one time step, density/√dt,
- the variance of one time step, density²/dt.

The last two forms hold for N and K alike. A program with discrete noise adds (dt σ)² to the variance of an angle
or a velocity in each step. This variance must be N² dt, so that σ = N/√dt. For a bias, it must be K² dt, so that σ =
K/√dt. ``docs/reference/export.md`` names the documentation or source code on which each entry is based.
"""

import math
from dataclasses import dataclass
from enum import Enum
from typing import Final

from drivers.errors import ConfigError
from monitor.common.unit_formatting import Kind
from monitor.publishing.exporters.export_input import (
    NoiseCoefficients,
    ascii_unit,
    choose_time_step_s,
    comment_on_omitted_terms,
    find_worst_axis,
    format_float,
    header_comments,
    join_lines,
)

EKF2_STEP_S: Final = 0.01  # default of EKF2_PREDICT_US, 10 000 µs
EKF3_STEP_S: Final = 0.012  # EKF_TARGET_DT of AP_NavEKF3


class NoiseParameterForm(Enum):
    """Form in which the parameters of a program state the noise."""

    DENSITY = "continuous-time density"
    SQUARED_DENSITY = "continuous-time covariance"
    SIGMA = "standard deviation of one time step"
    VARIANCE = "variance of one time step"

    @property
    def squared(self) -> bool:
        """True if the parameter is proportional to the square of N or K."""
        return self in (NoiseParameterForm.SQUARED_DENSITY, NoiseParameterForm.VARIANCE)

    @property
    def discrete(self) -> bool:
        """True if the parameter depends on the time step of the program."""
        return self in (NoiseParameterForm.SIGMA, NoiseParameterForm.VARIANCE)

    def convert(self, coefficient: float, dt_s: float) -> float:
        """Convert a coefficient N or K to the parameter.

        >>> NoiseParameterForm.SIGMA.convert(1e-3, 0.01), NoiseParameterForm.SQUARED_DENSITY.convert(1e-3, 0.01)
        (0.01, 1e-06)

        Parameters
        ----------
        coefficient
            N or K, in SI units.
        dt_s
            Time step [s], which only discrete parameters depend on.
        """
        value = coefficient / math.sqrt(dt_s) if self.discrete else coefficient
        return value**2 if self.squared else value

    def unit(self, unit: str) -> str:
        """Return the unit of the parameter in ASCII.

        >>> NoiseParameterForm.DENSITY.unit("rad/s"), NoiseParameterForm.VARIANCE.unit("rad/s")
        ('rad/s/sqrt(Hz)', '(rad/s)^2')

        Parameters
        ----------
        unit
            Unit of the signal for N, or of its derivative for K.
        """
        if self.squared:
            return f"({unit})^2" if self.discrete else f"({unit})^2/Hz"
        return unit if self.discrete else f"{unit}/sqrt(Hz)"

    def formula(self, letter: str) -> str:
        """Return the formula of the parameter, such as ``N^2/dt``."""
        if self.squared:
            return f"{letter}^2/dt" if self.discrete else f"{letter}^2"
        return f"{letter}/sqrt(dt)" if self.discrete else letter


@dataclass(frozen=True, slots=True)
class Parameter:
    """Parameter of a target program, set from N or K of one kind of sensor."""

    name: str
    kind: Kind
    letter: str
    documented_range: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class ParameterFile:
    """Syntax and parameters of a file that a target program reads.

    The texts may contain ``{rate}`` for the sample rate [Hz] and ``{rostopic}`` for the ROS topic.
    """

    name: str
    title: str  # first comment
    form: NoiseParameterForm
    parameters: tuple[Parameter, ...]
    line: str = "{name}: {value}"
    first_lines: tuple[str, ...] = ()  # lines that must precede the comments
    notes: tuple[str, ...] = ()  # further comments
    before: tuple[str, ...] = ()
    after: tuple[str, ...] = ()
    default_dt_s: float | None = None  # time step of the program; by default, the sample period
    is_fragment: bool = False  # True if the lines replace those of a larger file, so that a model may lack K

    @property
    def options(self) -> frozenset[str]:
        """Names of the options that ``export`` accepts."""
        topic = any("{rostopic}" in text for text in (*self.before, *self.after))
        return frozenset(("dt_s",) * self.form.discrete + ("rostopic",) * topic)

    def export(
        self, noise: NoiseCoefficients, inflation: float = 1.0, dt_s: float | None = None, rostopic: str = "/imu0"
    ) -> str:
        """Return the text of the parameter file.

        Parameters
        ----------
        noise
            Noise coefficients of each axis, in SI units.
        inflation
            Factor that multiplies N and K.
        dt_s
            Time step of the target program [s]. If None, the default of the program or the sample period is used.
        rostopic
            ROS topic on which the IMU publishes.

        Raises
        ------
        ConfigError
            If the sample rate is needed and unknown, or if the noise model lacks a required coefficient.
        NotReady
            If the recording determines none of the coefficients.
        """
        step_s = self._time_step_s(noise, dt_s)
        filled = {"rate": repr(noise.sample_rate_hz), "rostopic": rostopic}
        lines = [
            *self.first_lines,
            f"# {self.title}",
            *header_comments(noise, inflation, "#"),
            *(f"# {note}" for note in self.notes),
            *(text.format_map(filled) for text in self.before),
        ]
        known = [one for one in self.parameters if noise.coefficient_by_axis(one.kind, one.letter)]
        for one in self.parameters:
            if one not in known and known and (noise.measured or (self.is_fragment and one.letter == "K")):
                why = "not measured" if noise.measured else "not in the model"
                lines.append(f"# {one.name} is left out: {one.letter} of the {one.kind} axes is {why}")
            else:
                lines += self._parameter_lines(one, noise, inflation, step_s)
        letters = {one.letter for one in self.parameters}
        return join_lines([*lines, *self.after, *comment_on_omitted_terms(noise, letters, "#")])

    def _parameter_lines(self, one: Parameter, noise: NoiseCoefficients, inflation: float, step_s: float) -> list[str]:
        """Return the line of a parameter, after comments on its unit and on the axis that it comes from."""
        worst, comment = find_worst_axis(noise, one.kind, one.letter, self.name)
        value = self.form.convert(worst.value * inflation, step_s)
        unit = self.form.unit(ascii_unit("B" if one.letter == "N" else "R", one.kind))
        at = f", dt = {step_s:g} s ({1.0 / step_s:g} Hz)" if self.form.discrete else ""
        lines = [
            f"# {one.name} [{unit}] = {self.form.formula(one.letter)}, {self.form.value}{at}",
            f"# {one.letter}: {comment}{'' if inflation == 1.0 else f'; times {inflation:g}'}",
        ]
        if one.documented_range and not one.documented_range[0] <= value <= one.documented_range[1]:
            lines.append("# outside the documented range, {:g} to {:g}".format(*one.documented_range))
        return [*lines, self.line.format(name=one.name, value=format_float(value))]

    def _time_step_s(self, noise: NoiseCoefficients, dt_s: float | None) -> float:
        """Return the time step of the target program. Continuous-time values do not depend on the time step."""
        rate_hz = noise.sample_rate_hz
        if rate_hz is None and any("{rate}" in text for text in self.before):
            raise ConfigError(f"{self.name} needs an update_rate, and the model has no sample_rate")
        dt_s = self.default_dt_s if dt_s is None else dt_s
        if dt_s is None and rate_hz is None and not self.form.discrete:
            return 1.0
        return choose_time_step_s(noise, dt_s, self.name)


def _noise_and_bias(gyro_n: str, accel_n: str, gyro_k: str, accel_k: str) -> tuple[Parameter, ...]:
    """Return the four parameters of a program that reads N and K of gyroscopes and accelerometers."""
    return (
        Parameter(accel_n, "accel", "N"),
        Parameter(accel_k, "accel", "K"),
        Parameter(gyro_n, "gyro", "N"),
        Parameter(gyro_k, "gyro", "K"),
    )


KALIBR_PARAMETERS: Final = _noise_and_bias(
    "gyroscope_noise_density",
    "accelerometer_noise_density",
    "gyroscope_random_walk",
    "accelerometer_random_walk",
)
KALIBR_LINES: Final = (
    "rostopic: {rostopic}  # topic of the IMU in the bag for Kalibr",
    "update_rate: {rate}  # Hz",
)
OPENCV_FIRST_LINES: Final = ("%YAML:1.0",)

_IDENTITY: Final = ("[1.0, 0.0, 0.0]", "[0.0, 1.0, 0.0]", "[0.0, 0.0, 1.0]")
_CALIBRATION: Final = (
    '  model: "kalibr"',
    *(
        line
        for name in ("Tw", "R_IMUtoGYRO", "Ta", "R_IMUtoACC")
        for line in (f"  {name}:", *(f"    - {row}" for row in _IDENTITY))
    ),
    "  Tg:",
    *("    - [0.0, 0.0, 0.0]",) * 3,
)

PARAMETER_FILES: Final = (
    ParameterFile(
        "kalibr",
        "imu.yaml for Kalibr: continuous-time noise; one value for each kind of sensor, from the worst axis",
        NoiseParameterForm.DENSITY,
        KALIBR_PARAMETERS,
        notes=(
            "Kalibr's wiki, IMU Noise Model: a sensor at rest at constant temperature has less noise; for the",
            "lowest-cost sensors it may be necessary to raise these values by a factor of 10 or more (inflation 10)",
        ),
        before=KALIBR_LINES,
    ),
    ParameterFile(
        "allan_variance_ros",
        "imu.yaml as allan_variance_ros writes it, for Kalibr",
        NoiseParameterForm.DENSITY,
        KALIBR_PARAMETERS,
        before=("rostopic: '{rostopic}'", "update_rate: {rate}"),
    ),
    ParameterFile(
        "openvins",
        "kalibr_imu_chain.yaml for OpenVINS",
        NoiseParameterForm.DENSITY,
        KALIBR_PARAMETERS,
        line="  {name}: {value}",
        first_lines=OPENCV_FIRST_LINES,
        notes=("T_i_b, Tw, Ta, Tg and the rotations are placeholders: replace them by your calibration",),
        before=(
            "imu0:",
            "  T_i_b:",
            "    - [1.0, 0.0, 0.0, 0.0]",
            "    - [0.0, 1.0, 0.0, 0.0]",
            "    - [0.0, 0.0, 1.0, 0.0]",
            "    - [0.0, 0.0, 0.0, 1.0]",
            "  rostopic: {rostopic}",
            "  time_offset: 0.0",
            "  update_rate: {rate}",
        ),
        after=_CALIBRATION,
    ),
    ParameterFile(
        "vins_fusion",
        "IMU parameters for the configuration file of VINS-Fusion or VINS-Mono",
        NoiseParameterForm.SIGMA,
        _noise_and_bias("gyr_n", "acc_n", "gyr_w", "acc_w"),
        first_lines=OPENCV_FIRST_LINES,
        is_fragment=True,
    ),
    ParameterFile(
        "orb_slam3",
        "IMU parameters for the settings file of ORB-SLAM3",
        NoiseParameterForm.DENSITY,
        _noise_and_bias("IMU.NoiseGyro", "IMU.NoiseAcc", "IMU.GyroWalk", "IMU.AccWalk"),
        first_lines=OPENCV_FIRST_LINES,
        before=("IMU.Frequency: {rate}",),
        is_fragment=True,
    ),
    ParameterFile(
        "lio_sam",
        "IMU parameters for params.yaml of LIO-SAM; in the branch ros2, the first key is /**: with ros__parameters:",
        NoiseParameterForm.DENSITY,
        _noise_and_bias("imuGyrNoise", "imuAccNoise", "imuGyrBiasN", "imuAccBiasN"),
        line="  {name}: {value}",
        before=("lio_sam:",),
        is_fragment=True,
    ),
    ParameterFile(
        "fast_lio",
        "IMU parameters for the configuration file of FAST-LIO",
        NoiseParameterForm.VARIANCE,
        _noise_and_bias("gyr_cov", "acc_cov", "b_gyr_cov", "b_acc_cov"),
        line="    {name}: {value}",
        before=("mapping:",),
        is_fragment=True,
    ),
    ParameterFile(
        "gtsam",
        "Parameters of GTSAM for PreintegratedCombinedMeasurements, in Python",
        NoiseParameterForm.SQUARED_DENSITY,
        _noise_and_bias(
            "setGyroscopeCovariance", "setAccelerometerCovariance", "setBiasOmegaCovariance", "setBiasAccCovariance"
        ),
        line="params.{name}({value} * np.eye(3))",
        notes=(
            "PreintegrationParams, for PreintegratedImuMeasurements, has no bias covariances",
            "integrationCovariance and biasAccOmegaInt do not depend on the sensor and are not set here",
        ),
        before=(
            "import gtsam",
            "import numpy as np",
            "",
            "params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.80665)  # z up; MakeSharedD for z down",
        ),
        is_fragment=True,
    ),
    ParameterFile(
        "px4_ekf2",
        "Parameters of EKF2 of PX4, for QGroundControl; --dt is EKF2_PREDICT_US in seconds",
        NoiseParameterForm.SIGMA,
        (
            Parameter("EKF2_ACC_NOISE", "accel", "N", (0.01, 1.0)),
            Parameter("EKF2_ACC_B_NOISE", "accel", "K", (0.0, 0.01)),
            Parameter("EKF2_GYR_NOISE", "gyro", "N", (0.0001, 0.1)),
            Parameter("EKF2_GYR_B_NOISE", "gyro", "K", (0.0, 0.01)),
        ),
        line="1\t1\t{name}\t{value}\t9",
        notes=(
            "the defaults of PX4, 0.35 m/s^2 and 0.015 rad/s, exceed the noise of most sensors at rest",
            "Vehicle-Id Component-Id Name Value Type",
        ),
        default_dt_s=EKF2_STEP_S,
        is_fragment=True,
    ),
    ParameterFile(
        "ardupilot_ekf3",
        "Parameters of EKF3 of ArduPilot; --dt is the time step of EKF3 in seconds",
        NoiseParameterForm.SIGMA,
        (
            Parameter("EK3_ACC_P_NSE", "accel", "N", (0.01, 1.0)),
            Parameter("EK3_ABIAS_P_NSE", "accel", "K", (0.00001, 0.02)),
            Parameter("EK3_GYRO_P_NSE", "gyro", "N", (0.0001, 0.1)),
            Parameter("EK3_GBIAS_P_NSE", "gyro", "K", (0.00001, 0.001)),
        ),
        line="{name},{value}",
        notes=("the defaults of ArduPilot, 0.35 m/s^2 and 0.015 rad/s, exceed the noise of most sensors at rest",),
        default_dt_s=EKF3_STEP_S,
        is_fragment=True,
    ),
    ParameterFile(
        "robot_localization",
        "Covariances of sensor_msgs/Imu, from which robot_localization takes the noise of an IMU",
        NoiseParameterForm.VARIANCE,
        (
            Parameter("angular_velocity_covariance", "gyro", "N"),
            Parameter("linear_acceleration_covariance", "accel", "N"),
        ),
        line="{name}: [{value}, 0.0, 0.0, 0.0, {value}, 0.0, 0.0, 0.0, {value}]",
        notes=("process_noise_covariance describes the motion of the vehicle and does not depend on the IMU",),
        is_fragment=True,
    ),
)
"""Parameter files with one value for each kind of sensor. Kalibr is first, because other programs use its names."""
