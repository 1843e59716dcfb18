"""Identification of the layout of text lines that contain numbers.

The texts between the numbers of each line are compared. If they are the same in nearly all lines, the numbers are
assigned to columns by their labels, such as ``A:``, ``gyro`` or ``ax =``. If no label names an axis, the numbers are
assigned by their size at rest, where an accelerometer measures gravity. Lines of numbers with separators and labels are
described by ``columns``, and all other lines by ``pattern``.
"""

import re
from collections import Counter
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from drivers import units
from drivers.data_types import AXES, Floats
from drivers.decoders.text_lines.text.settings import SKIP

MIN_LINES: Final = 5
MIN_NUMBERS: Final = 3
MIN_MATCHING_LINES: Final = 0.9
"""Minimum fraction of lines that must have the most common layout."""
MIN_PRINTABLE: Final = 0.97
"""Minimum fraction of printable characters in readable text. Text at a wrong baud rate has far fewer."""
MIN_TEXT_CHARACTERS: Final = 30
"""Minimum length of readable text. Shorter noise could consist of printable characters by chance."""
NUMBER: Final = re.compile(r"(?:(?<![\w.)\]])[-+])?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|\bnan\b")
NUMBER_IN_PATTERN: Final = "[-+.0-9eE]+"
NMEA_SENTENCE: Final = re.compile(r"\$(.*)\*[0-9A-Fa-f]{2}")
COLUMN_TEXT: Final = re.compile(r"( *[,;\t] *| +|)(?:[A-Za-z][\w /]*: *)?")
"""Text before a number that the text decoder reads without a pattern."""
LABELS: Final = {
    "a": re.compile(r"a|acc|accel|acceleration|accelerometer|xl"),
    "g": re.compile(r"g|gyr|gyro|gyroscope|w|omega|angular|rot|rotation"),
    "temperature": re.compile(r"temp|temperature|tmp"),
    "t": re.compile(r"time|ts|timestamp|ms|us|millis|micros|ticks?"),
    "counter": re.compile(r"cnt|count|counter|seq|sequence|n|idx|index|frame"),
    "angle": re.compile(r"roll|pitch|yaw|heading|angle[_.]?[xyz]"),
    "angles": re.compile(r"euler|rpy|ypr|angles?"),
    "magnetic field": re.compile(r"m|mag|magn|magnetometer|m(?:ag)?[_.]?[xyz]"),
    "quaternion": re.compile(r"q|quat|quaternion|q[_.]?[wxyz]"),
    "environment": re.compile(r"baro|pressure|p|hum|humidity|alt|altitude"),
}
"""Labels of each quantity in lower case. ``a`` and ``g`` stand for three axes."""
GROUP_SIZES: Final = {"a": 3, "g": 3, "angles": 3, "magnetic field": 3, "quaternion": 4}
"""Number of values after one label, where it is not 1."""
NOT_USED: Final = frozenset(["angle", "angles", "magnetic field", "quaternion", "environment"])
AXIS_LABEL: Final = re.compile(
    r"(?P<kind>ac?c?|accel|g|gyr?|gyro|w|omega)[_.]?(?P<axis>[xyz])|(?P<first>[xyz])[_.]?(?P<last>a|acc|accel|g|gyro?)"
)
GRAVITY: Final = {"m/s²": units.G0, "g": 1.0, "mg": 1000.0} | {f"g/{n}": float(n) for n in (2048, 4096, 8192, 16384)}
"""Size of gravity in each unit of an accelerometer."""
GRAVITY_TOLERANCE: Final = 0.08


def decode_readable_lines(data: bytes) -> list[str]:
    """Return the lines of captured bytes without empty lines, or an empty list if the bytes are not readable text."""
    text = data.decode("utf-8", "replace")
    printable = sum(one in "\r\n\t\b\x1b" or (one.isprintable() and one != "\N{REPLACEMENT CHARACTER}") for one in text)
    lines = [line.strip() for line in data.decode("ascii", "replace").replace("\r", "\n").split("\n")]
    readable = len(text) >= MIN_TEXT_CHARACTERS and len(lines) > 1 and printable >= MIN_PRINTABLE * len(text)
    return [line for line in lines if line] if readable else []


def identify_text_layout(lines: Sequence[str]) -> tuple[dict[str, Any], int]:
    """Return the options of the text decoder and the number of lines that they fit, or ({}, 0) if there are none.

    Units are among the options only if the lines or gravity show them.
    """
    nmea = [found[1] for line in lines if (found := NMEA_SENTENCE.fullmatch(line))]
    split = [_split_at_numbers(line) for line in nmea or lines]
    layouts = Counter(tuple(map(_collapse_blanks, texts)) for texts, _ in split)
    layout, matching = layouts.most_common(1)[0] if layouts else ((), 0)
    if len(layout) <= MIN_NUMBERS or matching < max(MIN_LINES, MIN_MATCHING_LINES * len(lines)):
        return {}, 0
    alike = [one for one in split if tuple(map(_collapse_blanks, one[0])) == layout]
    table = np.array([[float(number) for number in numbers] for _, numbers in alike])
    columns = _name_columns(layout[:-1], table)
    if not set(columns) & set(AXES):
        return {}, 0
    separators = [COLUMN_TEXT.fullmatch(text) for text in layout[:-1]]
    options: dict[str, Any] = {"columns": columns}
    if layout[-1] or not all(separators) or len({one[1].strip(" ") for one in separators[1:] if one}) > 1:
        variants = [sorted({texts[i] for texts, _ in alike}) for i in range(len(layout))]
        options = {"pattern": _write_pattern(variants, columns)}
    if nmea:
        options["nmea"] = True
    words = set(re.split(r"[\s,;:|()\[\]=]+", NUMBER.sub(" ", lines[-1].replace("^2", "²").replace("s2", "s²"))))
    gyro_units = [unit for unit in units.RATE if unit in words]
    accel_units = [unit for unit in ("m/s²", "mg") if unit in words] or _find_accel_units(columns, table)
    options |= {"gyro_unit": gyro_units[0]} if gyro_units else {}
    options |= {"accel_unit": accel_units[0]} if accel_units else {}
    options |= {"time_unit": _guess_time_unit(table[:, columns.index("t")])} if "t" in columns else {}
    return options, matching


def _split_at_numbers(line: str) -> tuple[list[str], list[str]]:
    """Return the n + 1 texts around the n numbers of a line, and the numbers.

    An integer that continues a word or a unit, as in ``acc1`` or ``m/s^2``, belongs to the text.
    """
    texts, numbers, end = [""], [], 0
    for match in NUMBER.finditer(line):
        texts[-1] += line[end : match.start()]
        if match[0].isdigit() and re.search(r"[A-Za-z_^]$", texts[-1]):
            texts[-1] += match[0]
        else:
            texts.append("")
            numbers.append(match[0])
        end = match.end()
    texts[-1] += line[end:]
    return texts, numbers


def _collapse_blanks(text: str) -> str:
    """Return a text without blanks at punctuation, and with one blank elsewhere for several.

    >>> _collapse_blanks("  deg  A :  ")
    ' deg A:'
    """
    return re.sub(r" +", " ", re.sub(r" *([^\w\s]|\t) *", r"\1", text))


def _name_columns(labels: Sequence[str], table: Floats) -> list[str]:
    """Return the name of each number, "-" for a number that is not used.

    Parameters
    ----------
    labels
        Text before each number, shape [n].
    table
        Numbers, shape [lines, n].
    """
    steps = np.diff(table, axis=0)
    increases = np.all(steps > 0.0, axis=0)
    columns: list[str] = []
    kind, used = SKIP, 3  # the last label of a kind, and how many numbers belong to it
    first = labels[0].rstrip(" ,;|\t")  # a separator after the label of the line, as in ``ypr,1,2,3``
    for label, increasing in zip((first, *labels[1:]), increases.tolist(), strict=True):
        name = SKIP
        for word in _list_label_words(label, within_group=kind in ("a", "g") and 0 < used < 3):
            named = AXIS_LABEL.fullmatch(word)
            found = [one for one, words in LABELS.items() if words.fullmatch(word)]
            if named:
                name = ("a" if (named["kind"] or named["last"])[0] == "a" else "g") + (named["axis"] or named["first"])
            elif word in ("x", "y", "z") and kind in ("a", "g"):
                name, used = kind + word, 3
            elif word == "t" or found:
                kind, used = found[0] if found else "t" if increasing else "temperature", 0
        if name == SKIP and kind != SKIP and used < GROUP_SIZES.get(kind, 1):
            name = kind + "xyz"[used] if kind in ("a", "g") else kind
            used += 1
        columns.append(name)
    columns = [SKIP if name in columns[:i] and name not in NOT_USED else name for i, name in enumerate(columns)]
    if not set(columns) & set(AXES):
        columns = _assign_axes_by_size(columns, table)
    columns = [SKIP if name in NOT_USED else name for name in columns]
    is_clock = {"t": increases, "counter": np.all(steps == 1.0, axis=0) & ("t" not in columns)}
    return [SKIP if name in is_clock and not is_clock[name][i] else name for i, name in enumerate(columns)]


def _list_label_words(text: str, within_group: bool) -> list[str]:
    """Return the words in the text before a number that can be labels.

    Between the three axes of a group, as in ``A 0.1g 0.2g 0.3g``, a word without ``:`` or ``=`` is a unit.
    """
    words = re.findall(r"[a-z_.]+", re.sub(r"\bm/s\S*", "", re.split(r"[,;|\t]", text)[-1].lower()))
    return words if not within_group or re.search("[:=]", text) else [one for one in words if AXIS_LABEL.fullmatch(one)]


def _assign_axes_by_size(columns: Sequence[str], table: Floats) -> list[str]:
    """Return the columns with axes for three numbers that measure gravity, and for the three smallest others."""
    columns = list(columns)
    steps = np.diff(table[:, 0])
    if columns[0] == SKIP and (steps > 0.0).all():
        columns[0] = "counter" if (steps == 1.0).all() else "t"
    medians = np.median(table, axis=0)
    sizes = [float(np.linalg.norm(medians[i : i + 3])) for i in range(len(columns) - 2)]
    free = [i for i, size in enumerate(sizes) if columns[i : i + 3] == [SKIP] * 3 and np.isfinite(size)]
    if not free:
        return columns
    with_gravity = [i for i in free if _find_gravity_units(sizes[i])]
    if with_gravity or len(free) > 3:
        accel = min(with_gravity or [max(free, key=sizes.__getitem__)], key=lambda i: ((i - free[0]) % 3 > 0, i))
        columns[accel : accel + 3] = AXES[3:]
        free = [i for i in free if abs(i - accel) >= 3]
    if free:
        gyro = min(free, key=sizes.__getitem__)
        columns[gyro : gyro + 3] = AXES[:3]
    return columns


def _find_accel_units(columns: list[str], table: Floats) -> list[str]:
    """Return the units in which the accelerometer measures gravity."""
    at = [columns.index(name) for name in AXES[3:] if name in columns]
    return _find_gravity_units(float(np.linalg.norm(np.nanmedian(table[:, at], axis=0)))) if len(at) == 3 else []


def _find_gravity_units(size: float) -> list[str]:
    return [unit for unit, gravity in GRAVITY.items() if abs(size / gravity - 1.0) < GRAVITY_TOLERANCE]


def _guess_time_unit(times: Floats) -> str:
    """Return the unit in which the steps of a device clock correspond to a usual sample rate."""
    step = float(np.median(np.diff(times)))
    if (times != np.rint(times)).any():
        return "s"
    return "ms" if step < 200.0 else "us" if step < 5e5 else "ns"


def _write_pattern(texts: Sequence[Sequence[str]], columns: Sequence[str]) -> str:
    """Return a regular expression for lines.

    Parameters
    ----------
    texts
        All variants of the n + 1 texts around the numbers, which differ only in blanks.
    columns
        Names of the n numbers.
    """
    groups = [NUMBER_IN_PATTERN if name == SKIP else f"(?P<{name}>{NUMBER_IN_PATTERN})" for name in columns]
    parts = [_write_text_pattern(variants) for variants in texts]
    return "^" + "".join(map("".join, zip(parts, [*groups, ""], strict=True))) + "$"


def _write_text_pattern(variants: Sequence[str]) -> str:
    text = variants[0]
    if any(" " in one for one in variants):
        text = re.sub(r"( *)([^\w\s]|\t)( *)", "\0\\2\0", text)  # blanks at punctuation are optional
        text = re.sub("\0+", "\0", text)
    parts = {" ": " +", "\0": " *", "\N{REPLACEMENT CHARACTER}": ".", "\t": "\t"}
    return "".join(parts.get(one, re.escape(one)) for one in re.sub(" +", " ", text))
