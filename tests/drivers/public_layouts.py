"""Layouts of recordings that public programs and data sets use, as generators of small files.

Each layout writes the samples of the same kind of sensor at rest: white noise of 0.05 °/s and 0.01 m/s², a bias and an
inclination that differ between the axes. The names of columns are facts of the formats; the numbers are generated.
``docs/reference/layouts.md`` lists the layouts and is generated from ``LAYOUTS``.
"""

import io
import zipfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

import numpy as np

from drivers.data_types import AXES, Floats
from drivers.units import DEGREE, G0

GYRO_NOISE: Final = 0.05 * DEGREE
ACCEL_NOISE: Final = 0.01
UNIX_S: Final = 1_709_290_800.0
START: Final = datetime(2024, 3, 1, 11, 0, 0, tzinfo=UTC)
WEEK_S: Final = 604_800.0


@dataclass(frozen=True)
class Sensor:
    """Samples of a sensor at rest.

    Attributes
    ----------
    t
        Times [n] in s, beginning at 0.
    gyro, accel
        Angular rates and specific forces [n, 3] in rad/s and m/s².
    temperature
        Temperatures [n] in °C.
    """

    rate_hz: float
    t: Floats
    gyro: Floats
    accel: Floats
    temperature: Floats

    @property
    def deg(self) -> Floats:
        return self.gyro / DEGREE

    @property
    def g(self) -> Floats:
        return self.accel / G0


def simulate_sensor(rate_hz: float, seed: int = 1, n: int = 1500) -> Sensor:
    rng = np.random.default_rng(seed)
    gyro = np.array([0.31, -0.16, 0.12]) * DEGREE + GYRO_NOISE * rng.standard_normal((n, 3))
    accel = np.array([1.2, -3.4, 9.12]) + ACCEL_NOISE * rng.standard_normal((n, 3))
    return Sensor(rate_hz, np.arange(n) / rate_hz, gyro, accel, 25.0 + 0.01 * rng.standard_normal(n))


def table(header: str, *columns: Any, separator: str = ",", decimals: int = 6, before: str = "", end: str = "") -> str:
    """Return a header and one line per row. A column is an array [n] or [n, k], or a sequence of texts."""
    fields: list[Sequence[str]] = []
    for column in columns:
        if isinstance(column, np.ndarray):
            for one in column.T if column.ndim == 2 else [column]:
                whole = one.dtype.kind in "iu"
                fields.append([str(value) if whole else f"{value:.{decimals}f}" for value in one.tolist()])
        else:
            fields.append(list(column))
    lines = [separator.join(row) + end for row in zip(*fields, strict=True)]
    return before + "\n".join([*([header] if header else []), *lines]) + "\n"


def constant(s: Sensor, value: Any) -> list[str]:
    return [str(value)] * len(s.t)


def zeros(s: Sensor, columns: int) -> Floats:
    return np.zeros((len(s.t), columns))


def counter(s: Sensor, start: int = 0) -> Any:
    return start + np.arange(len(s.t))


def whole(values: Floats) -> Any:
    return np.rint(values).astype(np.int64)


def text_times(s: Sensor, pattern: str, digits: int = 3) -> list[str]:
    """Return times as text. ``%f`` in the pattern has a number of digits."""
    times = (START + timedelta(seconds=float(t)) for t in s.t)
    return [
        one.strftime(pattern.replace("%f", "@")).replace("@", f"{one.microsecond:06d}000"[:digits]) for one in times
    ]


Write = Callable[[Sensor, Path], Path]
"""Function that writes the samples below a folder, and returns the path to read."""


@dataclass(frozen=True)
class Layout:
    """A layout of recordings and what the reader is expected to do with it.

    Attributes
    ----------
    name, source, peculiarity
        Program or data set, where the layout is described, and what is unusual about it.
    write
        Writes a recording.
    options
        Options that the message asks for, with the values that are right for the file. An option without a value
        has the value of the command in the message. Empty if the recording is read without options.
    axes
        Axes that the recording has.
    resolution
        Largest error of the samples in rad/s and m/s² that the digits of the file cause.
    refused
        Part of the message of a recording that cannot be read with any option.
    """

    name: str
    source: str
    peculiarity: str
    write: Write
    rate_hz: float = 100.0
    options: str = ""
    axes: tuple[str, ...] = AXES
    resolution: float = 2e-5
    refused: str = ""


LAYOUTS: Final[list[Layout]] = []


def layout(
    name: str,
    source: str,
    peculiarity: str,
    file: str,
    **options: Any,
) -> Callable[[Callable[[Sensor], str | bytes]], Callable[[Sensor], str | bytes]]:
    """Add a layout of a single file. The decorated function returns the content."""

    def add(content: Callable[[Sensor], str | bytes]) -> Callable[[Sensor], str | bytes]:
        def write(sensor: Sensor, folder: Path) -> Path:
            found = content(sensor)
            (folder / file).write_bytes(found if isinstance(found, bytes) else found.encode())
            return folder / file

        LAYOUTS.append(Layout(name, source, peculiarity, write, **options))
        return content

    return add


def layout_of_folder(
    name: str, source: str, peculiarity: str, folder_name: str, **options: Any
) -> Callable[[Callable[[Sensor], dict[str, str]]], Callable[[Sensor], dict[str, str]]]:
    """Add a layout of several files in a folder, or in a zip archive. The decorated function returns the contents."""

    def add(content: Callable[[Sensor], dict[str, str]]) -> Callable[[Sensor], dict[str, str]]:
        def write(sensor: Sensor, folder: Path) -> Path:
            path = folder / folder_name
            files = content(sensor)
            if path.suffix == ".zip":
                with zipfile.ZipFile(path, "w") as archive:
                    for name, text in files.items():
                        archive.writestr(name, text)
                return path
            path.mkdir()
            for name, text in files.items():
                (path / name).write_text(text)
            return path

        LAYOUTS.append(Layout(name, source, peculiarity, write, **options))
        return content

    return add


def interleave(*rows: Iterable[tuple[float, str]]) -> str:
    """Return lines in the order of their times."""
    merged = sorted((row for part in rows for row in part), key=lambda row: row[0])
    return "".join(f"{line}\n" for _, line in merged)


def join_fields(*values: float, decimals: int = 6) -> str:
    return ",".join(f"{value:.{decimals}f}" for value in values)


# --- data sets -----------------------------------------------------------------------------------


@layout(
    "EuRoC, TUM-VI (ASL)",
    "projects.asl.ethz.ch/datasets",
    "comment as header, units with exponents, ns",
    "data.csv",
    rate_hz=200.0,
)
def _(s: Sensor) -> str:
    header = "#timestamp [ns]," + ",".join(
        [f"w_RS_S_{axis} [rad s^-1]" for axis in "xyz"] + [f"a_RS_S_{axis} [m s^-2]" for axis in "xyz"]
    )
    return table(header, whole(1e9 * s.t) + int(UNIX_S) * 10**9, s.gyro, s.accel)


@layout(
    "Kalibr",
    "ethz-asl/kalibr, kalibr_bagcreater",
    "accelerations are named alpha, ns without a unit",
    "imu0.csv",
    rate_hz=200.0,
)
def _(s: Sensor) -> str:
    header = "timestamp,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z"
    return table(header, whole(1e9 * s.t) + int(UNIX_S) * 10**9, s.gyro, s.accel)


@layout(
    "UZH-FPV",
    "fpv.ifi.uzh.ch, bag_to_folder scripts",
    "text file, header is a comment, blanks, row number",
    "imu.txt",
    rate_hz=500.0,
)
def _(s: Sensor) -> str:
    header = "# id timestamp ang_vel_x ang_vel_y ang_vel_z lin_acc_x lin_acc_y lin_acc_z"
    return table(header, counter(s), UNIX_S + s.t, s.gyro, s.accel, separator=" ", decimals=8)


@layout(
    "RIDI, RoNIN",
    "RIDI, data/processed/data.csv",
    "column of row numbers without a name, two other accelerations",
    "data.csv",
    rate_hz=200.0,
)
def _(s: Sensor) -> str:
    triads = ("gyro", "acce", "linacce", "grav", "magnet", "pos")
    header = ",time," + ",".join(f"{triad}_{axis}" for triad in triads for axis in "xyz") + ",ori_w,ori_x,ori_y,ori_z"
    gravity = np.tile(s.accel.mean(axis=0), (len(s.t), 1))
    return table(
        header, counter(s), whole(1e9 * (1234.0 + s.t)), s.gyro, s.accel, s.accel - gravity, gravity, zeros(s, 10)
    )


@layout(
    "OxIOD",
    "deepio.cs.ox.ac.uk",
    "no header; gravity and acceleration are separate columns",
    "imu1.csv",
    options="--columns t=1,gx=5,gy=6,gz=7",
    axes=AXES[:3],
)
def _(s: Sensor) -> str:
    gravity = np.tile(s.g.mean(axis=0), (len(s.t), 1))
    return table("", 5000.0 + s.t, 0.1 + zeros(s, 3), s.gyro, gravity, s.g - gravity, 30.0 + zeros(s, 3))


@layout(
    "NCLT",
    "robots.engin.umich.edu/nclt, ms25.csv",
    "no header; magnetometer before the IMU; µs",
    "ms25.csv",
    rate_hz=50.0,
    options="--columns",
)
def _(s: Sensor) -> str:
    magnetic = np.random.default_rng(5).standard_normal((len(s.t), 3)) * 1e-3 + 0.2
    return table("", whole(1e6 * (UNIX_S + s.t)), magnetic, s.accel, s.gyro)


@layout(
    "PAMAP2",
    "UCI Machine Learning Repository",
    "no header; 54 columns, three sensors, NaN",
    "subject101.dat",
    options="--columns",
)
def _(s: Sensor) -> str:
    imu = [s.temperature, s.accel, s.accel, s.gyro, zeros(s, 3), constant(s, 1), zeros(s, 3)]
    return table("", 8.38 + s.t, constant(s, 0), constant(s, "NaN"), *imu, *imu, *imu, separator=" ")


@layout(
    "mHealth",
    "UCI Machine Learning Repository",
    "no header, no times, .log",
    "mHealth_subject1.log",
    rate_hz=50.0,
    options="--columns --rate",
)
def _(s: Sensor) -> str:
    other = np.random.default_rng(5).standard_normal((len(s.t), 5)) * [0.02, 0.02, 0.02, 0.1, 0.1] + [
        9.8,
        0.1,
        0.3,
        0,
        0,
    ]
    return table("", other, s.accel, s.gyro, zeros(s, 12), constant(s, 0), separator="\t")


@layout_of_folder(
    "Zurich Urban MAV",
    "rpg.ifi.uzh.ch/zurichmavdataset",
    "one file per triad; misspelled name of the times; raw values beside",
    "Log Files",
    rate_hz=250.0,
)
def _(s: Sensor) -> dict[str, str]:
    header = "Timpstemp, Error_count, x, y, z, temperature, range_rad_s, scaling, x_raw, y_raw, z_raw, temperature_raw"
    t_us = whole(1e6 * (12.5 + s.t))
    other = (constant(s, 0), s.temperature, constant(s, 34.906), constant(s, 0.001064))

    def write(values: Floats) -> str:
        return table(header, t_us, other[0], values, *other[1:], whole(1000.0 * values), whole(s.temperature))

    return {"RawGyro.csv": write(s.gyro), "RawAccel.csv": write(s.accel)}


@layout("comma2k19 as .npz", "github.com/commaai/comma2k19", "n×3 arrays with a vector of times", "imu.npz")
def _(s: Sensor) -> bytes:
    file = io.BytesIO()
    np.savez(file, t=s.t, gyro=s.gyro, acc=s.accel)
    return file.getvalue()


@layout("TartanIMU, others", "array of all axes", "one n×6 array, times in another", "segment.npz", options="--columns")
def _(s: Sensor) -> bytes:
    file = io.BytesIO()
    np.savez(file, ts=UNIX_S + s.t, imu=np.hstack([s.gyro, s.accel]).astype(np.float32))
    return file.getvalue()


@layout_of_folder(
    "ADVIO, RIDI (raw files)",
    "AaltoVision/ADVIO",
    "one file per sensor without a header: time x y z",
    "iphone",
)
def _(s: Sensor) -> dict[str, str]:
    return {
        "gyroscope.csv": table("", 5.0 + s.t, s.gyro),
        "accelerometer.csv": table("", 5.001 + s.t, s.accel),
        "barometer.csv": table("", s.t, zeros(s, 2)),
    }


# --- phones and watches --------------------------------------------------------------------------


@layout_of_folder(
    "Sensor Logger", "github.com/tszheichoi/awesome-sensor-logger", "one file per sensor, axes z y x", "walk-2024"
)
def _(s: Sensor) -> dict[str, str]:
    t_ns = whole(1e9 * s.t) + int(UNIX_S) * 10**9

    def write(values: Floats) -> str:
        return table("time,seconds_elapsed,z,y,x", t_ns, s.t, values[:, ::-1])

    gravity = s.accel.mean(axis=0)
    return {
        "Gyroscope.csv": write(s.gyro),
        "TotalAcceleration.csv": write(s.accel),
        "Accelerometer.csv": write(s.accel - gravity),
        "Metadata.csv": "version,device name\n3,x\n",
    }


@layout_of_folder(
    "phyphox",
    "github.com/phyphox/phyphox-android, DataExport.java",
    "zip archive, one file per sensor",
    "Acceleration.zip",
)
def _(s: Sensor) -> dict[str, str]:
    def write(sensor: str, unit: str, values: Floats) -> str:
        return table(",".join(['"Time (s)"', *(f'"{sensor} {axis} ({unit})"' for axis in "xyz")]), s.t, values)

    return {
        "Gyroscope.csv": write("Gyroscope", "rad/s", s.gyro),
        "Accelerometer.csv": write("Acceleration", "m/s^2", s.accel),
        "meta/device.csv": '"property","value"\n"version","1.1.9"\n',
    }


@layout(
    "Physics Toolbox",
    "vieyrasoftware.net, Multi Record",
    "g-force gFx beside wx, total and comma at the end",
    "2024-03-01.csv",
)
def _(s: Sensor) -> str:
    total = np.linalg.norm(s.g, axis=1)
    return table("time,gFx,gFy,gFz,TgF,wx,wy,wz,", s.t, s.g, total, s.gyro, end=",")


@layout(
    "SensorLog (iOS)",
    "columns quoted in public scripts",
    "four time columns, calibrated and raw gyroscope",
    "2024-03-01.csv",
    options="",
)
def _(s: Sensor) -> str:
    names = ["loggingTime(txt)", "accelerometerTimestamp_sinceReboot(s)"]
    names += [f"accelerometerAcceleration{axis}(G)" for axis in "XYZ"] + ["gyroTimestamp_sinceReboot(s)"]
    names += [f"gyroRotation{axis}(rad/s)" for axis in "XYZ"] + ["motionTimestamp_sinceReboot(s)"]
    names += [f"motionRotationRate{axis}(rad/s)" for axis in "XYZ"] + [
        f"motionUserAcceleration{axis}(G)" for axis in "XYZ"
    ]
    texts = text_times(s, "%Y-%m-%d %H:%M:%S.%f +0100")
    t = 4321.0 + s.t
    user = s.g - s.g.mean(axis=0)
    return table(",".join(names), texts, t, s.g, t + 0.001, s.gyro, t, s.gyro - s.gyro.mean(axis=0), user)


@layout(
    "AndroSensor", "forum posts with its files", "semicolons, sep= line, cp1252, text time last", "Sensor_record.csv"
)
def _(s: Sensor) -> bytes:
    names = [f"{sensor} {axis} (m/s²)" for sensor in ("ACCELEROMETER", "LINEAR ACCELERATION") for axis in "XYZ"]
    names += [*(f"GYROSCOPE {axis} (rad/s)" for axis in "XYZ"), "TIME SINCE START (ms)", "YYYY-MO-DD HH-MI-SS_SSS"]
    texts = text_times(s, "%Y-%m-%d %H:%M:%S:%f")
    text = table(
        ";".join(names),
        s.accel,
        s.accel - s.accel.mean(axis=0),
        s.gyro,
        whole(1000.0 * s.t),
        texts,
        separator=";",
        before="sep=;\n",
    )
    return text.encode("cp1252")


@layout(
    "GnssLogger",
    "google/gps-measurement-tools, LOGGING_FORMAT.md",
    "rows of many sensors, told apart by their first word; headers are comments",
    "gnss_log.txt",
)
def _(s: Sensor) -> str:
    head = (
        "# \n# Header Description:\n# \n"
        "# Raw,utcTimeMillis,TimeNanos,LeapSecond,FullBiasNanos\n"
        "# Fix,Provider,LatitudeDegrees,LongitudeDegrees,AltitudeMeters\n"
        "# UncalAccel,utcTimeMillis,elapsedRealtimeNanos,UncalAccelXMps2,UncalAccelYMps2,UncalAccelZMps2,BiasXMps2,"
        "BiasYMps2,BiasZMps2\n"
        "# UncalGyro,utcTimeMillis,elapsedRealtimeNanos,UncalGyroXRadPerSec,UncalGyroYRadPerSec,UncalGyroZRadPerSec,"
        "DriftXRadPerSec,DriftYRadPerSec,DriftZRadPerSec\n# \n"
    )

    def rows(name: str, values: Floats, delay_s: float) -> list[tuple[float, str]]:
        return [
            (
                t,
                f"{name},{round(1e3 * (UNIX_S + t))},{round(1e9 * (t + 99.0 + delay_s))},{join_fields(*value)},0,0,0",
            )
            for t, value in zip(s.t.tolist(), values.tolist(), strict=True)
        ]

    fixes = [(float(t), f"Fix,GPS,46.5,8.2,{400 + t}") for t in range(15)]
    return head + interleave(rows("UncalGyro", s.gyro, 0.0), rows("UncalAccel", s.accel, 0.001), fixes)


@layout(
    "Polar Sensor Logger",
    "columns quoted in public programs",
    "x y z whose unit shows the sensor; two time columns",
    "Polar_Gyro.txt",
    rate_hz=52.0,
    axes=AXES[:3],
    resolution=1e-4,
)
def _(s: Sensor) -> str:
    texts = text_times(s, "%Y-%m-%dT%H:%M:%S.%f")
    t_ns = whole(1e9 * (599_616_050.0 + s.t))
    return table("Phone timestamp;sensor timestamp [ns];X [dps];Y [dps];Z [dps] ", texts, t_ns, s.deg, separator=";")


# --- wearable and industrial sensors -------------------------------------------------------------


@layout(
    "Xsens MT Manager", "text export of MT Manager", "// comments, tabs; SampleTimeFine counts 0.1 ms", "MT_0120.txt"
)
def _(s: Sensor) -> str:
    before = "// General information: \n//  MT Manager version: 2022.2.0 \n// Update Rate: 100.0Hz\n"
    names = ["PacketCounter", "SampleTimeFine", "Year", "Month", "Day", "Second"]
    names += [f"{triad}_{axis}" for triad in ("Acc", "Gyr") for axis in "XYZ"] + ["Roll", "Pitch", "Yaw"]
    nan = constant(s, "NaN")
    return table(
        "\t".join(names),
        counter(s, 51_400),
        whole(1e4 * s.t) + 8_765_000,
        nan,
        nan,
        nan,
        nan,
        s.accel,
        s.gyro,
        zeros(s, 3),
        separator="\t",
        before=before,
    )


@layout(
    "Movella DOT",
    "export of the Movella DOT app",
    "sep= line and preamble; SampleTimeFine counts µs",
    "Xsens DOT.csv",
    rate_hz=60.0,
)
def _(s: Sensor) -> str:
    before = "sep=,\nDeviceTag:,Xsens DOT\nFirmwareVersion:,2.0.0\nOutputRate:,60Hz\n\n"
    names = ["PacketCounter", "SampleTimeFine"]
    names += [f"{triad}_{axis}" for triad in ("FreeAcc", "Acc", "Gyr") for axis in "XYZ"]
    free = s.accel - s.accel.mean(axis=0)
    return table(",".join(names), counter(s, 1), whole(1e6 * s.t) + 50_671_017, free, s.accel, s.deg, before=before)


@layout(
    "MicroStrain Inertial",
    "log of MIP Monitor and SensorConnect",
    "sections before the header, codes in brackets, GPS week and seconds",
    "preamble.csv",
)
def _(s: Sensor) -> str:
    before = "FILE_INFO\nListSeparator=comma\n\nSESSION_INFO\nStartTime,02/10/2017 16:13:52\n\nDATA_START\n"
    names = ["GPS TFlags", "GPS Week", "GPS TOW"]
    names += [f"{axis} {triad} [{code}]" for triad, code in (("Accel", "x8004"), ("Gyro", "x8005")) for axis in "XYZ"]
    return table(",".join(names), constant(s, 6), constant(s, 2199), 434_567.89 + s.t, s.g, s.gyro, before=before)


@layout(
    "WitMotion, new",
    "export of the WitMotion program",
    "tabs, ISO time, AsX for the angular rate, null",
    "20240301.txt",
)
def _(s: Sensor) -> str:
    names = ["time", "DeviceName", "ChipTime()"]
    names += [
        f"{triad}{axis}({unit})" for triad, unit in (("Acc", "g"), ("As", "°/s"), ("Angle", "°")) for axis in "XYZ"
    ]
    return table(
        "\t".join(names),
        text_times(s, "%Y-%m-%dT%H:%M:%S.%f"),
        constant(s, "HC-06(00:0C)"),
        constant(s, "null"),
        s.g,
        s.deg,
        zeros(s, 3),
        separator="\t",
    )


@layout(
    "WitMotion, old", "MiniIMU export", "blank-padded tabs, start time before the header, ax(g) wx(deg/s)", "data.tsv"
)
def _(s: Sensor) -> str:
    names = ["address", "Time(s)", *(f"a{axis}(g)" for axis in "xyz"), *(f"w{axis}(deg/s)" for axis in "xyz")]
    return table(
        "\t".join(names),
        constant(s, "0x50"),
        s.t,
        s.g,
        s.deg,
        separator="\t",
        before="StartTime: 2024-03-01 11:00:00.000\n",
    )


@layout(
    "Shimmer Consensys",
    "shimmersensing.com, CSV export",
    "sep=, tabs, prefix of the device, row of units, two accelerometers",
    "session.csv",
    options="--topic ln",
)
def _(s: Sensor) -> str:
    names = ["Shimmer_8665_Timestamp_Unix_CAL"]
    names += [f"Shimmer_8665_{triad}_{axis}_CAL" for triad in ("Accel_LN", "Accel_WR", "Gyro") for axis in "XYZ"]
    units = ["ms", *["m/(s^2)"] * 6, *["deg/s"] * 3]
    header = "\t".join(names) + "\t\n" + "\t".join(units) + "\t"
    wide = s.accel + 0.05 * np.random.default_rng(4).standard_normal(s.accel.shape)
    return table(header, 1e3 * (UNIX_S + s.t), s.accel, wide, s.deg, separator="\t", before='"sep=\t"\n', end="\t")


@layout(
    "ST Unico, MEMS Studio",
    "columns quoted in public scripts",
    "mg and mdps, preamble, no times",
    "unico.txt",
    rate_hz=104.0,
    options="--rate 104",
    resolution=1e-4,
)
def _(s: Sensor) -> str:
    names = [f"acc_{axis}[mg]" for axis in "xyz"] + [f"gyro_{axis}[mdps]" for axis in "xyz"]
    return table(
        "\t".join(names),
        1000.0 * s.g,
        1000.0 * s.deg,
        separator="\t",
        decimals=2,
        before="STEVAL-MKI109V3\nLSM6DSOX\n\n",
    )


@layout("STWIN HSDatalog", "STMicroelectronics HSDatalog SDK", "A_x and G_x", "sensor.csv", rate_hz=208.0)
def _(s: Sensor) -> str:
    names = ["Time", *(f"A_{axis} [g]" for axis in "xyz"), *(f"G_{axis} [dps]" for axis in "xyz")]
    return table(",".join(names), 0.172246 + s.t, s.g, s.deg)


@layout(
    "OpenLog Artemis",
    "sparkfun/OpenLog_Artemis",
    "date and time in separate columns, mg and °/s without a unit, comma at the end",
    "dataLog00001.TXT",
    resolution=3e-4,
)
def _(s: Sensor) -> str:
    header = "rtcDate,rtcTime,aX,aY,aZ,gX,gY,gZ,mX,mY,mZ,imu_degC,output_Hz,"
    return table(
        header,
        text_times(s, "%d/%m/%Y"),
        text_times(s, "%H:%M:%S.%f", 2),
        1000.0 * s.g,
        s.deg,
        30.0 + zeros(s, 3),
        s.temperature,
        constant(s, "100.000"),
        decimals=2,
        end=",",
    )


@layout("ActiGraph GT9X", "ActiLife IMU export, AGread", "eleven lines before the header, date with time", "IMU.csv")
def _(s: Sensor) -> str:
    before = (
        "------------ Data File Created By ActiGraph GT9X Link ActiLife v6.13.4 date format M/d/yyyy at 100 Hz -----\n"
        "Serial Number: TAS1\nStart Time 11:00:00\nStart Date 3/1/2024\nEpoch Period (hh:mm:ss) 00:00:00\n"
        "Download Time 12:00:00\nDownload Date 3/1/2024\nCurrent Memory Address: 0\n"
        "Current Battery Voltage: 4.21     Mode = 12\n--------------------------------------------------\n"
    )
    names = ["Timestamp", *(f"Accelerometer {axis}" for axis in "XYZ"), "Temperature"]
    names += [f"Gyroscope {axis}" for axis in "XYZ"]
    return table(",".join(names), text_times(s, "%Y-%m-%dT%H:%M:%S.%f", 7), s.g, s.temperature, s.deg, before=before)


@layout(
    "Axivity cwa-convert",
    "digitalinteraction/openmovement",
    "no header, date with time, no gyroscope",
    "CWA-DATA.csv",
    options="--columns",
    axes=AXES[3:],
)
def _(s: Sensor) -> str:
    return table("", text_times(s, "%Y-%m-%d %H:%M:%S.%f"), s.g)


@layout(
    "LP-Research LPMS",
    "CSV header of the LPMS programs",
    "blanks after commas, number of the sensor, linear acceleration",
    "LpmsData.csv",
    options="",
)
def _(s: Sensor) -> str:
    names = ["SensorId", " TimeStamp (s)", " FrameNumber", *(f" Acc{axis} (g)" for axis in "XYZ")]
    names += [f" Gyro{axis} (deg/s)" for axis in "XYZ"] + [f" LinAcc{axis} (g)" for axis in "XYZ"]
    return table(",".join(names), constant(s, 1), s.t, counter(s), s.g, s.deg, s.g - s.g.mean(axis=0), separator=", ")


@layout(
    "x-io x-IMU3, NGIMU", "x-io Technologies, CSV export", "µs, °/s, g in the header", "Inertial.csv", rate_hz=400.0
)
def _(s: Sensor) -> str:
    names = ["Timestamp (us)", *(f"Gyroscope {axis} (deg/s)" for axis in "XYZ")]
    names += [f"Accelerometer {axis} (g)" for axis in "XYZ"]
    return table(",".join(names), whole(1e6 * (77.0 + s.t)), s.deg, s.g)


@layout(
    "GRID",
    "rnl-data.ae.utexas.edu, imu.txt",
    "no header; GPS week, whole seconds and fraction",
    "lord.log",
    options="--columns --rate",
)
def _(s: Sensor) -> str:
    tow = 518_400.0 + s.t
    return table("", constant(s, 2199), whole(np.floor(tow)), tow - np.floor(tow), s.accel, s.deg)


@layout("NovAtel OEM", "novatel_gps_msgs", "GPS week and seconds of the week over the end of the week", "rawimu.csv")
def _(s: Sensor) -> str:
    tow = WEEK_S - 7.0 + s.t
    names = ["gps_week", "gps_seconds", "x_accel", "y_accel", "z_accel", "x_gyro", "y_gyro", "z_gyro"]
    return table(",".join(names), whole(2199 + tow // WEEK_S), tow % WEEK_S, s.accel, s.gyro)


@layout("Swift Navigation", "swift-nav/libsbp, MSG_IMU_RAW", "time of week in ms", "imu.csv")
def _(s: Sensor) -> str:
    names = ["tow", *(f"acc_{axis}" for axis in "xyz"), *(f"gyr_{axis}" for axis in "xyz")]
    return table(",".join(names), whole(1e3 * (345_600.0 + s.t)), s.accel, s.gyro)


@layout(
    "Delsys EMGworks",
    "header described in public readers",
    "times in a column before each channel",
    "trial.csv",
    rate_hz=148.0,
    options="--columns t=1",
)
def _(s: Sensor) -> str:
    names = [
        f"Trigno IM sensor 1: {triad} 1 [{unit}]".replace(" 1 ", f" {axis} ")
        for triad, unit in (("ACC", "g"), ("GYRO", "deg/s"))
        for axis in "XYZ"
    ]
    columns = [part for value in (*s.g.T, *s.deg.T) for part in (s.t, value)]
    return table(",".join(f"X [s],{name}" for name in names), *columns)


# --- cameras, vehicles and autopilots ------------------------------------------------------------


@layout(
    "Gyroflow",
    "docs.gyroflow.xyz, gcsv format",
    "scales of the integers in lines before the header; .gcsv",
    "video.gcsv",
    rate_hz=1000.0,
    resolution=6e-3,
)
def _(s: Sensor) -> str:
    before = (
        "GYROFLOW IMU LOG\nversion,1.3\nid,custom_logger\norientation,YxZ\ntimestamp,1644159993\nvendor,x\n"
        "tscale,0.001\ngscale,0.00122173047\nascale,0.00048828125\n"
    )
    return table(
        "t,gx,gy,gz,ax,ay,az", counter(s), whole(s.gyro / 0.00122173047), whole(s.g / 0.00048828125), before=before
    )


@layout(
    "GoPro, named axes",
    "JuanIrache/gopro-telemetry",
    "axes in brackets before the unit, text and number of the time",
    "GX010001_GYRO.csv",
    rate_hz=200.0,
    axes=AXES[:3],
)
def _(s: Sensor) -> str:
    names = ["cts", "date", *(f"Gyroscope ({axis}) [rad/s]" for axis in "zxy"), "temperature [°C]"]
    return table(
        ",".join(names), 177.0 + 1e3 * s.t, text_times(s, "%Y-%m-%dT%H:%M:%S.%fZ"), s.gyro[:, [2, 0, 1]], s.temperature
    )


@layout(
    "GoPro, numbered columns",
    "JuanIrache/gopro-telemetry",
    "second and third axis have numbers as names; axes z x y",
    "GX010001_ACCL.csv",
    rate_hz=200.0,
    options="--columns az=3,ax=4,ay=5",
    axes=AXES[3:],
)
def _(s: Sensor) -> str:
    names = ["cts", "date", "Accelerometer [m/s2]", "1", "2", "temperature [°C]"]
    return table(
        ",".join(names), 177.0 + 1e3 * s.t, text_times(s, "%Y-%m-%dT%H:%M:%S.%fZ"), s.accel[:, [2, 0, 1]], s.temperature
    )


@layout(
    "FlySight 2",
    "flysight/flysight-2-firmware, log.c",
    "rows of many sensors, told apart by their first field; names and units in lines of their own",
    "SENSOR.CSV",
    rate_hz=12.5,
    resolution=1e-4,
)
def _(s: Sensor) -> str:
    head = (
        "$FLYS,1\n$VAR,FIRMWARE_VER,v2024\n$COL,BARO,time,pressure,temperature\n$UNIT,BARO,s,Pa,deg C\n"
        "$COL,MAG,time,x,y,z,temperature\n$UNIT,MAG,s,gauss,gauss,gauss,deg C\n"
        "$COL,IMU,time,wx,wy,wz,ax,ay,az,temperature\n$UNIT,IMU,s,deg/s,deg/s,deg/s,g,g,g,deg C\n$DATA\n"
    )
    imu = [
        (t, f"$IMU,{t + 59970:.3f},{join_fields(*w)},{join_fields(*a)},25.64")
        for t, w, a in zip(s.t.tolist(), s.deg.tolist(), s.g.tolist(), strict=True)
    ]
    other = [(0.1 * i, f"$MAG,{0.1 * i + 59970:.3f},-0.258,-0.702,0.1,25.0") for i in range(1000)]
    return head + interleave(imu, other)


@layout(
    "Betaflight",
    "betaflight/blackbox-tools, blackbox_decode.c",
    "numbers in brackets for axes, no units, text at the end",
    "LOG00007.01.csv",
    rate_hz=1000.0,
    resolution=6e-3,
)
def _(s: Sensor) -> str:
    header = (
        "loopIteration, time (us), axisP[0], gyroADC[0], gyroADC[1], gyroADC[2], accSmooth[0], accSmooth[1], "
        "accSmooth[2], flightModeFlags (flags)"
    )
    return table(
        header,
        counter(s),
        whole(1e6 * s.t) + 55_158_008,
        constant(s, 3),
        s.deg,
        whole(2048 * s.g),
        constant(s, "ANGLE_MODE|ARM"),
        separator=", ",
    )


@layout(
    "PX4 ulog2csv",
    "PX4/pyulog, sensor_combined",
    "unit in the name of the quantity, axes as numbers in brackets, relative second time",
    "flight_sensor_combined_0.csv",
    rate_hz=250.0,
)
def _(s: Sensor) -> str:
    names = ["timestamp", *(f"gyro_rad[{i}]" for i in range(3)), "gyro_integral_dt", "accelerometer_timestamp_relative"]
    names += [*(f"accelerometer_m_s2[{i}]" for i in range(3)), "accelerometer_integral_dt"]
    return table(
        ",".join(names),
        whole(1e6 * (12.0 + s.t)),
        s.gyro,
        constant(s, 4000),
        constant(s, 0),
        s.accel,
        constant(s, 4000),
    )


@layout(
    "ArduPilot mavlogdump",
    "ArduPilot/pymavlink, mavlogdump.py --format csv",
    "two time columns; rows of two IMUs",
    "00000042.csv",
    rate_hz=50.0,
    options="--topic I=0",
)
def _(s: Sensor) -> str:
    names = "timestamp,TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"
    other = simulate_sensor(50.0, 8)
    rows = []
    for number, one, offset in ((0, s, 0.0), (1, other, 0.3)):
        rows.append(
            [
                (
                    t + 1e-4 * number,
                    f"{UNIX_S + t:.6f},{round(1e6 * (30 + t))},{number},"
                    f"{join_fields(*w)},{join_fields(*(a + offset))},0,0,35.1,1,1,50,50",
                )
                for t, w, a in zip(one.t.tolist(), one.gyro.tolist(), one.accel, strict=True)
            ]
        )
    return f"{names}\n{interleave(*rows)}"


@layout(
    "RealSense D435i",
    "pyrealsense2 scripts",
    "rows of two sensors with different rates; ms",
    "realsense.csv",
    rate_hz=200.0,
    options="--topic gyro",
    axes=AXES[:3],
)
def _(s: Sensor) -> str:
    gyro = [
        (t, f"{1e3 * (UNIX_S + t):.3f},gyro,{join_fields(*w)}")
        for t, w in zip(s.t.tolist(), s.gyro.tolist(), strict=True)
    ]
    t_accel = np.arange(470) / 62.5
    accel = [
        (t, f"{1e3 * (UNIX_S + t):.3f},accel,{join_fields(*a)}")
        for t, a in zip(t_accel.tolist(), s.accel.tolist(), strict=False)
    ]
    return "timestamp,stream,x,y,z\n" + interleave(gyro, accel)


@layout(
    "RaceChrono CSV v3",
    "racechrono.com, CSV v3",
    "metadata lines; row of units and row of sources after the header; repeated names",
    "session.csv",
    rate_hz=20.0,
)
def _(s: Sensor) -> str:
    before = 'This file is created using RaceChrono v7.5.0.\nFormat,3\nSession title,"x"\nCreated,01/03/2024,11:00\n\n'
    names = [
        "timestamp",
        "fragment_id",
        "lap_number",
        "elapsed_time",
        "speed",
        "device_update_rate",
        "x_acc",
        "y_acc",
        "z_acc",
    ]
    names += ["device_update_rate", *(f"{axis}_rate_of_rotation" for axis in "xyz")]
    units = "unix time,,,s,m/s,Hz,G,G,G,Hz,deg/s,deg/s,deg/s"
    sources = ",,,,100: gps,101: acc,101: acc,101: acc,101: acc,102: gyro,102: gyro,102: gyro,102: gyro"
    header = f"{','.join(names)}\n{units}\n{sources}"
    return table(
        header,
        UNIX_S + s.t,
        constant(s, 0),
        constant(s, ""),
        s.t,
        zeros(s, 1),
        constant(s, 20),
        s.g,
        constant(s, 20),
        s.deg,
        before=before,
    )


@layout(
    "Navio2 logger",
    "public logger for Navio2",
    "columns of two sensors with prefixes; two times",
    "imu.dat",
    rate_hz=200.0,
    options="--topic mpu9250",
)
def _(s: Sensor) -> str:
    parts = [f"{sensor}_{triad}{axis}" for sensor in ("mpu9250", "lsm9ds1") for triad in "agm" for axis in "xyz"]
    other = simulate_sensor(200.0, 9)
    return table(
        ",".join(["t", "us", *parts]),
        s.t,
        whole(1e6 * s.t),
        s.accel,
        s.gyro,
        zeros(s, 3),
        0.5 + other.accel,
        other.gyro,
        zeros(s, 3),
    )


@layout(
    "RaceBox, lap timers",
    "CSV export of RaceBox",
    "laps before the header, ISO times, g-force",
    "racebox.csv",
    rate_hz=25.0,
)
def _(s: Sensor) -> str:
    before = "Format,RaceBox\nTrack,X\nLap 1, 36.648, sectors, 10.167,12.115,0,14.366\n\n"
    names = ["Record", "Time", "Latitude", "Longitude", "Altitude (m)", "Speed (m/s)"]
    names += [*(f"GForce{axis} (g)" for axis in "XYZ"), "Lap", *(f"Gyro{axis} (deg/s)" for axis in "XYZ")]
    return table(
        ",".join(names),
        counter(s, 1),
        text_times(s, "%Y-%m-%dT%H:%M:%S.%fZ"),
        zeros(s, 4),
        s.g,
        constant(s, 1),
        s.deg,
        before=before,
    )


@layout("SavvyCAN", "collin80/SavvyCAN, GVRET CSV", "CAN frames, not samples", "drive.csv", refused="--decoder")
def _(s: Sensor) -> str:
    lines = "".join(f"{10_000 * i},0000021A,false,Rx,0,8,FE,36,12,FE,69,05,07,AD,\n" for i in range(500))
    return "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n" + lines


@layout(
    "candump",
    "linux-can/can-utils, candump -L",
    "CAN frames, not samples",
    "drive.txt",
    refused="CAN frames",
)
def _(s: Sensor) -> str:
    return "".join(f"({UNIX_S + t:.6f}) can0 21A#FE3612FE690507AD\n" for t in s.t.tolist())


# --- boards and scripts --------------------------------------------------------------------------


@layout(
    "rostopic echo -p", "wiki.ros.org/rostopic", "names of message fields; covariances; ns", "imu.csv", rate_hz=200.0
)
def _(s: Sensor) -> str:
    names = ["%time", "field.header.seq", "field.header.stamp", "field.header.frame_id"]
    names += [f"field.orientation.{axis}" for axis in "xyzw"]
    for vector in ("angular_velocity", "linear_acceleration"):
        names += [f"field.{vector}.{axis}" for axis in "xyz"] + [f"field.{vector}_covariance{i}" for i in range(3)]
    stamps = whole(1e9 * s.t) + int(UNIX_S) * 10**9
    return table(
        ",".join(names),
        stamps + 120_000,
        counter(s),
        stamps,
        constant(s, "imu"),
        zeros(s, 4),
        s.gyro,
        zeros(s, 3),
        s.accel,
        zeros(s, 3),
    )


@layout(
    "Edge Impulse",
    "docs.edgeimpulse.com, CSV",
    "times in ms from 0, accX and gyrX",
    "walk.csv",
    rate_hz=62.5,
    resolution=1e-4,
)
def _(s: Sensor) -> str:
    return table("timestamp,accX,accY,accZ,gyrX,gyrY,gyrZ", 1e3 * s.t, s.accel, s.deg, decimals=4)


@layout(
    "Arduino with MPU6050",
    "sketches with Adafruit and I2Cdev libraries",
    "messages of the boot loader; ms; g and °/s without a unit",
    "capture.txt",
    resolution=1e-3,
)
def _(s: Sensor) -> str:
    before = "ets Jun  8 2016 00:22:57\nrst:0x1 (POWERON_RESET)\nMPU6050 Found!\n"
    return table("millis,ax,ay,az,gx,gy,gz", whole(1e3 * s.t) + 5321, s.g, s.deg, decimals=4, before=before)


@layout(
    "Arduino, raw counts",
    "sketches with I2Cdev getMotion6",
    "integers of the sensor, no times",
    "counts.csv",
    options="--gyro-unit deg/s/131 --rate 100",
    resolution=1e-3,
)
def _(s: Sensor) -> str:
    return table("ax,ay,az,gx,gy,gz", whole(16384 * s.g), whole(131 * s.deg))


@layout(
    "PicoQuake",
    "PLab PicoQuake library, AcquisitionData.to_csv",
    "rate in a comment, counter but no times",
    "acquisition.csv",
    rate_hz=200.0,
)
def _(s: Sensor) -> str:
    before = "# PLab PicoQuake Data\n# Config: data_rate = 200.0 Hz, filter = 42 Hz, acc_range = 4 g\n"
    names = ["count", *(f"a_{axis}" for axis in "xyz"), *(f"g_{axis}" for axis in "xyz")]
    return table(",".join(names), counter(s), s.g, s.deg, before=before)


@layout("imudata for R", "SMAC-Group/imudata", "no times, names with dots", "imu6.csv", options="--rate 100")
def _(s: Sensor) -> str:
    names = [f"Gyro. {axis}" for axis in "XYZ"] + [f"Accel. {axis}" for axis in "XYZ"]
    return table(",".join(f'"{name}"' for name in names), s.gyro, s.accel)
