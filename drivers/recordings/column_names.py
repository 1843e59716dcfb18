"""Meaning of a column name: quantity, unit and sensor.

A column name consists of a sensor, an axis and a unit in any order, such as ``gyro_x [deg/s]``, ``wx (rad/s)``,
``X Gyro`` or ``imu2_acc_x_g``. The names of these programs are among the recognized names:

- EuRoC and TUM VI (ASL format): ``#timestamp [ns],w_RS_S_x [rad s^-1],a_RS_S_x [m s^-2]`` (the header that public
  readers and writers of these data sets quote)
- phyphox: ``"Time (s)","Gyroscope x (rad/s)"`` (phyphox/phyphox-android, ``DataExport.java``)
- Sensor Logger: ``time,seconds_elapsed,z,y,x`` in ``Gyroscope.csv`` (tszheichoi/awesome-sensor-logger, ``UNITS.md``)
- AndroSensor: ``ACCELEROMETER X (m/s²);…;TIME SINCE START (ms)``
- Betaflight: ``loopIteration, time (us), gyroADC[0], accSmooth[0]`` (betaflight/blackbox-tools, ``blackbox_decode.c``)
- ``rostopic echo -p``: ``%time,field.angular_velocity.x,field.linear_acceleration.x``

A word after the axis that is neither a known unit nor a known description may be a unit. It is returned as the unit, so
that the conversion rejects it.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from drivers import units
from drivers.data_types import AXES
from drivers.errors import ConfigError
from drivers.recordings.table import COLUMNS, TIME_NS


@dataclass(frozen=True, slots=True)
class QuantityKind:
    """Quantities that share a unit."""

    name: str  # used in messages
    quantities: tuple[str, ...]  # names in COLUMNS
    si_unit: str
    option: str  # option of the commands that states the unit
    convert: Callable[[str], tuple[float, float]]  # returns factor and offset of a unit; ConfigError if unknown
    spellings: Mapping[str, str]  # unit for each spelling of ``_unit_key``

    @property
    def key(self) -> str:
        """Field of ``ReadingOptions`` that states the unit."""
        return self.option.removeprefix("--").replace("-", "_")

    def find_unit(self, spelling: str) -> str | None:
        """Return the unit with a spelling such as ``deg_per_s`` or ``g/16384``, or None if no unit has it."""
        unit = self.spellings.get(_unit_key(spelling))
        if unit is None:
            try:
                self.convert(spelling)
            except ConfigError:
                return None
        return unit or spelling


KINDS: Final = (
    QuantityKind(
        "gyro", AXES[:3], "rad/s", "--gyro-unit", lambda unit: (units.angular_rate_factor(unit), 0.0),
        {
            "rads": "rad/s", "radps": "rad/s", "rps": "rad/s", "mrads": "mrad/s", "urads": "urad/s", "degs": "deg/s",
            "degps": "deg/s", "dps": "dps", "mdps": "mdps", "mdegs": "mdps", "degh": "deg/h", "dph": "deg/h",
        },
    ),
    QuantityKind(
        "accelerometer", AXES[3:], "m/s²", "--accel-unit", lambda unit: (units.acceleration_factor(unit), 0.0),
        {
            "g": "g", "gs": "g", "g0": "g", "gn": "g", "gravity": "g", "mg": "mg", "mgs": "mg", "ug": "ug",
            "ms2": "m/s²", "mps2": "m/s²", "mss": "m/s²", "mms2": "mm/s²", "mmps2": "mm/s²", "mmss": "mm/s²",
        },
    ),
    QuantityKind(
        "temperature", ("temperature",), "°C", "--temperature-unit", units.temperature_factor_and_offset,
        {
            "c": "°C", "degc": "°C", "celsius": "°C", "degcelsius": "°C", "k": "K", "kelvin": "K", "f": "°F",
            "degf": "°F",
        },
    ),
    QuantityKind(
        "time", ("t",), "s", "--time-unit", lambda unit: (units.time_factor(unit), 0.0),
        {
            "s": "s", "ms": "ms", "millis": "ms", "us": "us", "micros": "us", "ns": "ns", "nanos": "ns",
        },
    ),
)  # fmt: skip
GYRO, ACCELEROMETER, TEMPERATURE, TIME = KINDS
KIND_OF: Final[Mapping[str, QuantityKind]] = {name: kind for kind in KINDS for name in kind.quantities}

_SYNONYMS: Final = tuple(
    (re.compile(pattern), unit)
    for pattern, unit in (
        ("[\N{GREEK SMALL LETTER MU}\N{MICRO SIGN}]", "u"), ("[°º˚]", "deg"), ("²", "2"), ("[⁻-]?[¹1](?!\\d)", ""),
        ("milli(?!s\\b)", "m"), ("micro(?!s\\b)", "u"), ("nano(?!s\\b)", "n"), ("degrees?|degs(?=\\W|_|p)", "deg"),
        ("radians?|rads(?=\\W|_|p)", "rad"), ("seconds?|secs?", "s"), ("hours?|hr", "h"), ("met(?:er|re)s?", "m"),
        ("squared", "2"), ("per", ""), ("[^a-z0-9]", ""),
    )
)  # fmt: skip


def _unit_key(spelling: str) -> str:
    """Return a unit without case, blanks and signs.

    >>> _unit_key("Degrees/second"), _unit_key("m s^-2"), _unit_key("meters_per_second_squared")
    ('degs', 'ms2', 'ms2')
    """
    key = spelling.lower()
    for pattern, unit in _SYNONYMS:
        key = pattern.sub(unit, key)
    return key


SENSOR_NAMES: Final[Mapping[str, tuple[str, int]]] = {
    **dict.fromkeys(
        (
            "g", "w", "gyr", "gyro", "gyros", "gyroscope", "omega", "angular velocity", "angular rate", "angular speed",
            "ang vel", "angvel", "ang rate", "rotation rate", "rot rate", "rate of rotation", "rotational velocity",
            "turn rate", "rate of turn", "w rs s", "gyro adc", "gyro rotation", "gyroscope uncalibrated", "uncal gyro",
            "as", "角速度",
        ),
        ("g", 1),
    ),
    **dict.fromkeys(
        (
            "a", "acc", "acce", "accel", "acceleration", "accelerometer", "specific force", "a rs s", "acc smooth",
            "acc adc", "total acceleration", "accelerometer uncalibrated", "accelerometer acceleration", "uncal accel",
            "g force", "gforce", "accl", "加速度",
        ),
        ("a", 1),
    ),
    "body rate": ("g", 3),
    "alpha": ("a", 3),  # Kalibr; elsewhere an angular acceleration
    # On phones, these names mean the acceleration without gravity.
    **dict.fromkeys(
        (
            "linear acceleration", "linear accelerometer", "lin acc", "linacc", "linear accel", "user acceleration",
            "user accel", "user acc", "free acc",
        ),
        ("a", 2),
    ),
}  # fmt: skip
"""Letter and rank of each sensor. A lower rank is preferred."""
SAMPLE_TIME_FINE: Final = "sample time fine"
"""Column of Xsens. Its unit is 0.1 ms in files of MTi and MTw sensors, and 1 µs in files of Movella DOT sensors."""
TIME_NAMES: Final[Mapping[str, tuple[int, str | None]]] = {
    "seconds elapsed": (1, "s"), "time since start": (1, None), "time since start in": (1, None),
    "elapsed time": (1, None), "elapsed realtime": (1, None), "header stamp": (1, None), "timestamp": (2, None),
    "time stamp": (2, None), "time": (2, None), "stamp": (2, None), "ts": (2, None), "unix time": (2, None),
    "t": (2, None), "sensor timestamp": (2, None), "millis": (3, "ms"), "micros": (3, "us"),
    SAMPLE_TIME_FINE: (3, None), "gps seconds": (3, "s"), "gps so w": (3, "s"), "cts": (3, "ms"), "i tow": (3, None),
    "utc time": (5, None), "时间": (2, None),
}  # fmt: skip
"""Rank and implied unit of each column name that contains times."""
_TIME_WORDS: Final = frozenset(
    (
        "time", "timestamp", "stamp", "t", "elapsed", "epoch", "clock", "tow", "datetime", "itow", "sow",
    )
)  # fmt: skip
_WORDS_BESIDE_TIME: Final = frozenset(
    (
        "sample", "samples", "sensor", "imu", "system", "sys", "device", "host", "unix", "epoch", "utc", "gps",
        "local", "since", "start", "boot", "stamp", "elapsed", "time", "recording", "rec", "log", "logger", "of",
        "in", "relative", "total", "arduino", "pc", "mcu", "ros", "header", "measurement", "abs", "absolute", "clock",
        "run", "rtc", "date", "phone", "logging", "reboot", "gyro", "gyroscope", "accelerometer", "motion", "gnss",
    )
)  # fmt: skip
_OTHER_CLOCKS: Final = ("gyro", "gyroscope", "accelerometer", "motion", "phone", "host", "pc", "logging")
"""Words of times that are read only if there is no better column, the preferred word first."""
_COUNTER_WORDS: Final = frozenset(
    (
        "count", "counter", "cnt", "index", "idx", "id", "frame", "packet", "seq", "sequence", "sample", "row",
        "number", "no", "num", "loop", "iteration", "line", "record",
    )
)  # fmt: skip
TEMPERATURE_NAMES: Final = frozenset(
    ("temperature", "temp", "chip temperature", "chip temp", "die temperature", "die temp", "温度")
)
LEADING_WORDS: Final = frozenset(("imu", "field", "data", "sensor"))
"""Words that are ignored at the start of a column name."""
_DESCRIPTIONS: Final = frozenset(
    (
        "imu", "raw", "sensor", "data", "field", "cal", "calibrated", "uncal", "uncalibrated", "calib", "body",
        "frame", "axis", "value", "val", "meas", "measured", "measurement", "msg", "message", "fields", "si", "the",
        "of", "component", "signal", "in", "out",
    )
)  # fmt: skip
"""Words beside sensor and axis that change neither the quantity nor the unit."""
_OTHER_QUANTITIES: Final = frozenset(
    (
        "std", "sd", "stdev", "sigma", "var", "variance", "cov", "covariance", "bias", "biases", "offset", "mean",
        "avg", "min", "max", "rms", "err", "error", "scale", "range", "fs", "count", "counts", "flag", "flags",
        "valid", "status", "temp", "temperature", "delta", "int", "mag", "quat", "quaternion", "angle", "vel",
        "velocity", "pos", "position", "ref", "truth", "gt", "est", "estimate", "filtered", "filt", "lpf", "setpoint",
        "sp", "drift", "noise", "diff", "dot", "id", "time", "number", "residual", "jerk", "euler", "norm", "health",
        "clip", "clipping", "motor",
    )
)  # fmt: skip
"""Words of columns that do not contain the samples of a sensor."""
STANDARD_UNITS: Final = {"w rs s": "rad/s", "a rs s": "m/s²", "g force": "g", "gforce": "g"}
"""Units of columns whose format always has these units."""
ASSUMED_UNITS: Final = {"gyro adc": "deg/s", "acc smooth": "g/2048"}
"""Units of columns that never state their unit."""
UNSCALED: Final = frozenset(("raw", "lsb", "adc", "digits", "ticks"))
"""Words for numbers of which the column name does not state the scale."""
_BRACKETED: Final = re.compile(r"^(.*?)\s*[\[(]\s*([^\[\]()]*[^\W\d_°][^\[\]()]*?|°)\s*[\])]\s*$")
_CODE: Final = re.compile("0?x[0-9a-fA-F]+")
"""Number of a message field in brackets, as MicroStrain writes it."""
_AFTER_COMMA: Final = re.compile(r"^(.*\w)\s*,\s*([^,]*/[^,]*|m?g)\s*$")
AXIS_LETTERS: Final = ("x", "y", "z")
BODY_AXES: Final = {"roll": "x", "pitch": "y", "yaw": "z"}
_BODY_RATE: Final = re.compile(r"(roll|pitch|yaw)[ _.]?(?:rate|speed)", re.IGNORECASE)
_G_FORCE: Final = re.compile(r"\bgF(?=[xyz]\b)")
_INDEX: Final = re.compile(r"\[([012])\]")
_WORDS: Final = re.compile(r"[^\W\d_]?[^\W\d_A-Z]+|[A-Z]+(?![a-z])|\d+|²")


POSITIONS: Final = frozenset(
    (
        "left", "right", "front", "rear", "back", "top", "bottom", "upper", "lower", "wrist", "hand", "arm", "ankle",
        "foot", "leg", "thigh", "shank", "waist", "hip", "pelvis", "chest", "head", "trunk", "base", "primary",
        "secondary", "main",
    )
)  # fmt: skip
"""Words after the axis that name one of several sensors."""
SENSOR_COLUMNS: Final = frozenset(
    (
        "I", "id", "imu", "imu id", "sensor", "sensor id", "instance", "device", "device id", "dev", "node", "bus",
        "channel", "chan", "unit", "addr", "address", "source", "src", "imu no", "sensor no",
    )
)  # fmt: skip
"""Names of columns that tell the rows of several sensors apart."""


@dataclass(frozen=True, slots=True)
class ColumnName:
    """Meaning of a column name."""

    quantity: str  # name in COLUMNS
    rank: int  # at most 0 for the names of this program; a lower rank is preferred
    unit: str | None  # unit that the name states; None if it states none
    assumed: str | None = None  # unit of the column if nothing states it; None for the SI unit
    sensor: str = ""  # name of one of several sensors in the table, such as "imu2"


def parse_column_name(name: str, sensor: str = "") -> ColumnName | None:
    """Return the meaning of a column name, or None if the name is not recognized.

    Parameters
    ----------
    name
        Name of the column.
    sensor
        Name of the sensor for columns that are only named ``x``, ``y`` and ``z``.

    >>> parse_column_name("gyro_x [deg/s]")
    ColumnName(quantity='gx', rank=1, unit='deg/s', assumed=None, sensor='')
    >>> parse_column_name("z", sensor="TotalAcceleration").quantity
    'az'
    >>> parse_column_name("imu2_acc_x_mm_per_s2")
    ColumnName(quantity='ax', rank=2, unit='mm/s²', assumed=None, sensor='imu2')
    """
    if name in COLUMNS:
        return ColumnName(name, 0, None)
    if name == TIME_NS:
        return ColumnName("t", -1, "ns")
    stem, unit = split_unit(name)
    words = [] if stem.strip() == "T" else _split_words(stem)  # T is a time or a temperature
    while len(words) > 1 and (words[0] in LEADING_WORDS or words[0].isdigit()) and not _names_sensor(words):
        del words[0]
    if unit is not None and len(words) == 1 and words[0] in AXIS_LETTERS and not _is_magnetic(unit, sensor):
        sensor = next((kind.name for kind in KINDS if kind.find_unit(unit) is not None), sensor)
        words = words if sensor != "time" else ["time"]
    found = _match_time_or_temperature(words) or _match_axis(words, sensor)
    if found is None or unit is None:
        return found
    return ColumnName(found.quantity, found.rank, unit, found.assumed, found.sensor)


def counts_week_seconds(name: str) -> bool:
    """Return True if a column with this name contains the time since the start of the GPS week."""
    stem = split_unit(name)[0]
    words = _split_words(stem)
    return bool({"tow", "itow", "sow"} & {*words}) or " ".join(words) in ("gps seconds", "gps so w")


def names_sample_time_fine(name: str) -> bool:
    """Return True for the column SampleTimeFine of Xsens."""
    return " ".join(_split_words(name)) == SAMPLE_TIME_FINE


def names_sensor_kind(text: str) -> str:
    """Return "g" for the name of a gyroscope such as ``raw_gyro``, "a" for an accelerometer, or an empty text."""
    words = [word for word in _split_words(text) if not word.isdigit()]
    phrases = [" ".join(words[a:b]) for a in range(len(words)) for b in range(len(words), a, -1)]
    return next((SENSOR_NAMES[phrase][0] for phrase in phrases if len(phrase) > 2 and phrase in SENSOR_NAMES), "")


def _is_magnetic(unit: str, sensor: str) -> bool:
    """Return True for the gauss of a magnetometer, whose symbol G also means the acceleration of gravity."""
    return unit == "G" or "mag" in sensor.lower()


def suggests_time(name: str) -> bool:
    """Return True if a column may contain times: one of the words is that of a time, or the unit is one of time.

    >>> suggests_time("Timpstemp"), suggests_time("Shimmer_8665_Timestamp_Unix_CAL"), suggests_time("yaw")
    (True, True, False)
    """
    has_word = any(word in _TIME_WORDS or word.startswith("tim") for word in _split_words(name))
    return has_word or KIND_OF["t"].find_unit(split_unit(name)[1] or "") is not None


def names_counter(name: str) -> bool:
    """Return True if a column with this name counts rows, frames or packets."""
    return not _COUNTER_WORDS.isdisjoint(_split_words(name))


def names_sensor(name: str) -> bool:
    """Return True if a column with this name tells the rows of several sensors apart."""
    return name == "I" or " ".join(_split_words(name)) in SENSOR_COLUMNS


def split_unit(name: str) -> tuple[str, str | None]:
    """Split ``gyro x [deg/s]`` into name and unit. The unit is None if the name has no brackets with a unit."""
    found = _BRACKETED.match(name) or _AFTER_COMMA.match(name)
    if found is None:
        return name, None
    return found[1], None if _CODE.fullmatch(found[2]) else found[2]


def find_ending_unit(name: str, kind: QuantityKind) -> str | None:
    """Return the unit at the end of a column name whose other words are not recognized, or None."""
    stem, unit = split_unit(name)
    words = _split_words(stem)
    endings = (kind.spellings.get(_unit_key(" ".join(words[at:]))) for at in range(1, len(words)))
    return unit or next((one for one in endings if one is not None), None)


def _names_sensor(words: Sequence[str]) -> bool:
    """Return True for the words of ``imu 2 …``: the number belongs to the name of the sensor."""
    return words[0] in ("imu", "sensor") and words[1].isdigit()


def _split_words(text: str) -> list[str]:
    """Return the words of a column name in lower case.

    >>> _split_words("gyroADC[0]"), _split_words("imu.AngularVelocity.x")
    (['gyro', 'adc', 'x'], ['imu', 'angular', 'velocity', 'x'])
    """
    indexed = _INDEX.sub(lambda index: " " + "xyz"[int(index[1])], text.replace("°", " deg "))
    indexed = _G_FORCE.sub("gforce ", indexed)
    indexed = _BODY_RATE.sub(lambda found: f" body rate {BODY_AXES[found[1].lower()]} ", indexed)
    return [word.lower() for word in _WORDS.findall(indexed)]


def _match_time_or_temperature(words: Sequence[str]) -> ColumnName | None:
    for at in range(len(words), 0, -1):
        text, ending = " ".join(words[:at]), " ".join(words[at:])
        kind = KIND_OF["temperature" if text in TEMPERATURE_NAMES else "t"]
        unit = kind.spellings.get(_unit_key(ending))
        if ending and unit is None:
            continue
        if text in TEMPERATURE_NAMES:
            return ColumnName("temperature", 1, unit)
        if text in TIME_NAMES:
            rank, implied = TIME_NAMES[text]
            return ColumnName("t", rank, unit or implied)
        if any(word in _TIME_WORDS for word in words[:at]) and {*words[:at]} <= _TIME_WORDS | _WORDS_BESIDE_TIME:
            others = [_OTHER_CLOCKS.index(word) for word in words[:at] if word in _OTHER_CLOCKS]
            return ColumnName("t", 4 if not others else 5 + max(others), unit)
    return None


def _match_axis(words: Sequence[str], sensor: str) -> ColumnName | None:
    """Return the meaning of the words of an axis: words of the sensor, letter of the axis, and unit."""
    spelled, axis_at = _separate_axis(words)
    if axis_at is None:
        return None
    axis = spelled[axis_at]
    if len(spelled) == 1:
        spelled = [*_split_words(sensor), axis]
        axis_at = len(spelled) - 1
    for size in range(len(spelled) - 1, 0, -1):
        for first in range(len(spelled) - size + 1):
            phrase = spelled[first : first + size]
            known = SENSOR_NAMES.get(" ".join(phrase))
            if known is None or first <= axis_at < first + size:
                continue
            if len(phrase[0]) == 1 and first + size != axis_at:
                continue  # the letters a, g and w name a sensor only directly before the axis
            used = {*range(first, first + size), axis_at}
            end = max(used) + 1
            inner = [word for i, word in enumerate(spelled[:end]) if i not in used]
            return _describe_axis(known[0] + axis, known[1], " ".join(phrase), inner, spelled[end:])
    return None


def _separate_axis(words: Sequence[str]) -> tuple[list[str], int | None]:
    """Return the words with the axis as a word of its own, and the index of the axis."""
    for i, word in enumerate(words):
        if word in ("x", "y", "z"):
            return list(words), i
    for i, word in enumerate(words):
        if word[-1] in "xyz" and word[:-1] in SENSOR_NAMES:  # gyrox
            return [*words[:i], word[:-1], word[-1], *words[i + 1 :]], i + 1
        if word[0] in "xyz" and len(word) > 2 and word[1:] in SENSOR_NAMES:  # xgyro
            return [*words[:i], word[0], word[1:], *words[i + 1 :]], i
    return list(words), None


def _describe_axis(
    quantity: str, rank: int, phrase: str, inner: Sequence[str], ending: Sequence[str]
) -> ColumnName | None:
    """Return the meaning of an axis from the words before it and after it."""
    if _OTHER_QUANTITIES & {*inner, *ending}:
        return None
    spellings = KIND_OF[quantity].spellings
    at = next((at for at in range(len(ending)) if _unit_key(" ".join(ending[at:])) in spellings), len(ending))
    unit = spellings.get(_unit_key(" ".join(ending[at:]))) if at < len(ending) else None
    spans = [(a, b) for a in range(len(inner)) for b in range(len(inner), a, -1)]
    inner_unit = next(((a, b) for a, b in spans if _unit_key(" ".join(inner[a:b])) in spellings), None)
    if unit is None and inner_unit is not None:  # accG X, gyro_rad_s_x
        first, end = inner_unit
        unit, inner = spellings[_unit_key(" ".join(inner[first:end]))], [*inner[:first], *inner[end:]]
    unit = unit or STANDARD_UNITS.get(phrase)
    others = [word for word in ending[:at] if word not in _DESCRIPTIONS]
    if unit is None and phrase not in ASSUMED_UNITS:
        unit = next((word for word in (*others, *inner) if word in UNSCALED - {"raw"}), None)
    others = [word for word in others if word not in UNSCALED]
    if unit is None and "raw" in ending:
        return None  # raw counts are other columns
    unknown = [word for word in others if not word.isdigit() and word not in POSITIONS]
    if unit is None and unknown:
        unit, rank = " ".join(unknown), rank + 4
    numbered = inner[0] if inner and inner[0] in ("imu", "sensor") else ""
    names = [word for word in inner if word not in _DESCRIPTIONS | UNSCALED] + [
        word for word in others if word.isdigit() or word in POSITIONS
    ]
    sensor = "".join(names)
    return ColumnName(
        quantity, rank + bool(names), unit, ASSUMED_UNITS.get(phrase), numbered + sensor if sensor.isdigit() else sensor
    )
