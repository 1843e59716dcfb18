"""Units that a table does not state: a generator of layouts, and cases in which the numbers contradict SI units."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.data_types import AXES, Floats, Times
from drivers.errors import ConfigError, ImuError
from drivers.recordings.reading_options import create_reading_options
from drivers.recordings.table import Table, column_seconds
from drivers.recordings.table_layout import convert_to_si, find_layout
from drivers.units import DEGREE, G0, acceleration_factor, angular_rate_factor, time_factor

LAYOUTS = 2000
ROWS = 1200
GYRO_UNITS = ("rad/s", "deg/s", "mdps", "deg/s/131", "deg/s/16.4")
ACCEL_UNITS = ("m/s²", "g", "mg", "g/16384", "g/2048")
TIME_UNITS = ("s", "ms", "us", "ns")
SPELLINGS = {
    "rad/s": ("rad_s", "rad_per_s", "rads", " (rad/s)", " [rad s^-1]", "(Rad/sec)"),
    "deg/s": ("dps", "deg_per_s", "degs", " (°/s)", " [deg/s]", "(degrees/second)", "_DPS", " (deg/sec)"),
    "mdps": ("mdps", " [mdps]", "(mdps)"),
    "m/s²": ("m_s2", "mps2", " (m/s²)", " [m s^-2]", "(m/s^2)", "_ms2", " (meters/second^2)"),
    "g": ("g", "gs", " (g)", " [G]", "(g)"),
    "mg": ("mg", " [mg]", "(mg)"),
    "s": ("s", "sec", "seconds", " (s)", "[s]"),
    "ms": ("ms", "msec", " (ms)", "[milliseconds]"),
    "us": ("us", "usec", " [us]", " (µs)"),
    "ns": ("ns", " [ns]", "(nanoseconds)"),
}
GYRO_NAMES = (
    "g{}", "gyro_{}", "Gyro{}", "Gyr{}", "w{}", "ang_vel_{}", "angular_velocity.{}", "raw_angular_rate_{}", "{} Gyro",
    "IMU_Gyro_{}", "omega_{}", "rotation_rate_{}", "{}gyro", "Gyroscope {}", "GYRO {}", "imu.gyro.{}",
)  # fmt: skip
ACCEL_NAMES = (
    "a{}", "acc_{}", "Acc{}", "accel_{}", "acceleration_{}", "raw_acceleration_{}", "{} Accel", "IMU_Acc_{}", "{}acc",
    "Accelerometer {}", "ACC {}", "imu.accel.{}",
)  # fmt: skip
TIME_NAMES = ("t", "time", "timestamp", "Time", "sensor_time", "elapsed_time", "TimeStamp", "sample time")


class Layout:
    """A random table with known units.

    Attributes
    ----------
    names, columns
        Names and arrays of the table.
    units
        Unit of the times, angular rates and accelerations.
    rate_hz, samples
        Sample rate and samples [n, 6] in rad/s and m/s².
    """

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.rate_hz = float(rng.choice([10.0, 25.0, 50.0, 100.0, 104.0, 200.0, 400.0, 1000.0]))
        density = np.repeat([10.0 ** rng.uniform(-3.0, -1.6) * DEGREE, 10.0 ** rng.uniform(-3.1, -2.2)], 3)
        bias = np.r_[rng.normal(size=3) * 10.0 ** rng.uniform(-1.0, 0.3) * DEGREE, 0.2 * rng.normal(size=3)]
        up = rng.normal(size=3)
        bias[3:] += G0 * up / np.linalg.norm(up)
        self.samples = bias + density * np.sqrt(self.rate_hz) * rng.normal(size=(ROWS, 6))
        self.units = tuple(
            str(rng.choice(units, p=p))
            for units, p in (
                (TIME_UNITS, (0.4, 0.3, 0.2, 0.1)),
                (GYRO_UNITS, (0.37, 0.5, 0.1, 0.02, 0.01)),
                (ACCEL_UNITS, (0.4, 0.4, 0.1, 0.05, 0.05)),
            )
        )
        t_s = (
            rng.choice([0.0, 53.21, 1.7e9])
            + np.arange(ROWS) / self.rate_hz
            + 1e-4 / self.rate_hz * rng.normal(size=ROWS)
        )
        numbers = [t_s / time_factor(self.units[0])]
        numbers += [column / angular_rate_factor(self.units[1]) for column in self.samples.T[:3]]
        numbers += [column / acceleration_factor(self.units[2]) for column in self.samples.T[3:]]
        stems = [str(rng.choice(TIME_NAMES))]
        letters = "xyz" if rng.random() < 0.5 else "XYZ"
        stems += [str(rng.choice(GYRO_NAMES)).format(letter) for letter in letters[:1]]
        gyro, accel = str(rng.choice(GYRO_NAMES)), str(rng.choice(ACCEL_NAMES))
        stems = stems[:1] + [gyro.format(one) for one in letters] + [accel.format(one) for one in letters]
        kinds = [0, 1, 1, 1, 2, 2, 2]
        self.stated = [rng.random() < 0.7 for _ in range(3)]
        endings = [self._ending(rng, kind) for kind in range(3)]
        self.names = [f"{stem}{endings[kind]}" for stem, kind in zip(stems, kinds, strict=True)]
        self.integers = integers = [
            self.units[0] != "s",
            "/" in self.units[1][4:] or self.units[1] == "mdps",
            self.units[2] not in ("g", "m/s²"),
        ]
        self.columns: list[Times] = [
            np.rint(column).astype(np.int64)
            if integers[kind] and kind == 0
            else np.rint(column)
            if integers[kind]
            else column
            for column, kind in zip(numbers, kinds, strict=True)
        ]
        missing = rng.choice(["", "gyro", "accel"], p=[0.8, 0.1, 0.1])
        used = [i for i, kind in enumerate(kinds) if kind != {"gyro": 1, "accel": 2}.get(str(missing))]
        order = rng.permutation(used) if rng.random() < 0.5 else used
        self.measured = [i - 1 for i in used if i]
        self.names = [self.names[i] for i in order]
        self.columns = [self.columns[i] for i in order]

    def _ending(self, rng: np.random.Generator, kind: int) -> str:
        spellings = SPELLINGS.get(self.units[kind], ())
        if not self.stated[kind] or not spellings:
            return ""
        spelling = str(rng.choice(spellings))
        return spelling if spelling[0] in " [(_" else f"_{spelling}"

    def read(self, **options: str) -> Table:
        """Return the columns in SI units."""
        given = create_reading_options(options)
        layout = find_layout(Path("x.csv"), self.names, given, [])
        columns = {quantity: self.columns[i] for quantity, i in layout.columns.items()}
        table = Table(columns, None, [], layout.units, layout.names)
        return convert_to_si(Path("x.csv"), table, given)

    def is_right(self, table: Table) -> bool:
        """Return True if rate and samples are those of the sensor, within the resolution of the table."""
        rate_hz = 1.0 / np.mean(np.diff(column_seconds(table.columns)))
        right = abs(rate_hz / self.rate_hz - 1.0) < 0.01
        for axis in self.measured:
            if AXES[axis] not in table.columns:
                return False
            error = table.columns[AXES[axis]] - self.samples[:, axis]
            step = (angular_rate_factor if axis < 3 else acceleration_factor)(self.units[1 + axis // 3])
            right &= bool(np.abs(error).max() <= (0.51 if self.integers[1 + axis // 3] else 1e-9) * step)
        return right


def suggested_options(message: str) -> list[str]:
    """Return the names of the options that a message asks for, such as ``time_unit``."""
    words = message.partition("State the unit, such as ")[2].replace(",", "").split()
    return [word[2:].replace("-", "_") for word in words if word.startswith("--") and word != "--assume"]


def read_by_messages(layout: Layout) -> tuple[Table, int]:
    """Read a table with the options that the messages ask for. Return the table and the number of messages."""
    truth = dict(zip(("time_unit", "gyro_unit", "accel_unit"), layout.units, strict=True))
    options: dict[str, str] = {}
    for messages in range(4):
        try:
            return layout.read(**options), messages
        except ImuError as error:
            added = {key: truth[key] for key in suggested_options(str(error)) if key not in options}
            if not added:
                raise
            options |= added
    raise AssertionError(options)


def test_random_layouts() -> None:
    """No table is read wrongly. Most are read without options, and the others with those in the messages."""
    results = [(seed, layout, *read_by_messages(layout)) for seed, layout in ((i, Layout(i)) for i in range(LAYOUTS))]
    wrong = [
        f"{seed}: {layout.names} in {layout.units}, {messages} messages: {table.notes}"
        for seed, layout, table, messages in results
        if not layout.is_right(table)
    ]
    assert wrong == []
    assert sum(messages == 0 for *_, messages in results) >= 0.9 * LAYOUTS


def read(columns: dict[str, Times], **options: Any) -> Table:
    given = create_reading_options(options)
    layout = find_layout(Path("x.csv"), list(columns), given, [])
    arrays = list(columns.values())
    table = Table({q: arrays[i] for q, i in layout.columns.items()}, None, [], layout.units, layout.names)
    return convert_to_si(Path("x.csv"), table, given)


def at_rest(rate_hz: float = 100.0, gyro_noise: float = 0.05, n: int = 3000) -> tuple[Floats, Floats]:
    """Return times in s and samples [n, 6] in °/s and m/s². The sensor is at rest and inclined."""
    rng = np.random.default_rng(7)
    samples = rng.normal(size=(n, 6)) * np.repeat([gyro_noise, 0.01], 3) + [0.3, -0.16, 0.12, 0.0, 6.0, 7.757]
    return np.arange(n) / rate_hz, samples


def test_turning_gravity_shows_the_unit() -> None:
    """The noise fits both units, but gravity turns with the angular rates in deg/s only."""
    t_s, samples = at_rest(gyro_noise=0.2)
    angle = 0.5 * np.sin(2.0 * np.pi * 0.1 * t_s)
    samples[:, 0] = np.gradient(angle, t_s) / DEGREE
    samples[:, 3:] = G0 * np.stack([0.0 * t_s, np.sin(angle), np.cos(angle)], axis=1)
    samples += np.random.default_rng(1).normal(size=samples.shape) * 0.2
    columns = dict(
        zip(("time", "gyro_x", "gyro_y", "gyro_z", "acc_x", "acc_y", "acc_z"), (t_s, *samples.T), strict=True)
    )
    table = read(columns)
    np.testing.assert_allclose(table.columns["gx"], samples[:, 0] * DEGREE)
    assert "gyro in deg/s" in table.notes[0]
    assert "times the turn of gravity" in table.notes[0]
    for name in ("gyro_x", "gyro_y", "gyro_z"):
        columns[name] = columns[name] * DEGREE
    table = read(columns)
    assert table.notes == []
    np.testing.assert_array_equal(table.columns["gx"], columns["gyro_x"])


def test_a_bias_that_cannot_be_is_noticed_also_for_the_names_of_this_program() -> None:
    t_s, samples = at_rest()
    table = read(dict(zip(("t", *AXES), (t_s, *samples.T), strict=True)))
    assert table.notes == ["Units found from the numbers: gyro in deg/s (noise 0.005 °/s/√Hz, bias 0.36 °/s)."]
    t_s, samples = at_rest(gyro_noise=0.02)
    columns = dict(zip(("t", *AXES), (t_s, *samples.T), strict=True))
    with pytest.raises(ConfigError, match=r"gyro in deg/s \(noise 0.002 °/s/√Hz, bias 0.36 °/s\) or rad/s"):
        read(columns)
    table = read(columns, assume=True)
    assert table.notes[0].startswith("The likeliest units are assumed: gyro in deg/s (noise 0.002")
    np.testing.assert_allclose(table.columns["gy"], samples[:, 1] * DEGREE)
    np.testing.assert_array_equal(read(columns, gyro_unit="rad/s").columns["gy"], samples[:, 1])


def test_counter_and_time_in_ms_cannot_be_told_apart() -> None:
    _, samples = at_rest(1000.0)
    columns = {"time": np.arange(len(samples)), "gyro_x [deg/s]": samples[:, 0]}
    with pytest.raises(
        ConfigError, match=r"time in ms \(1000 Hz\) or row number \(give --columns t=- --rate HZ\).*--time-unit ms"
    ):
        read(columns)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("timestamp", "gyro_x (rad/h)"), '"rad/h" is not a unit of angular rate'),
        (("timestamp", "acc_x_furlong"), '"furlong" is not a unit of acceleration'),
    ],
)
def test_an_unknown_unit_is_never_ignored(names: tuple[str, str], expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        read(dict(zip(names, (np.arange(500) / 100.0, np.arange(500.0)), strict=True)))
