"""Lookup of the configured messages and signals in a DBC file.

The DBC file is read with cantools. A ``ConfigError`` lists all unknown names, unknown units and invalid signals.
"""

import contextlib
from collections.abc import Iterator, Mapping
from math import isfinite
from pathlib import Path
from typing import Any, Final

import drivers
from drivers import units
from drivers.data_types import ArrivalTimedFormat, CounterTimedFormat, Timing
from drivers.decoders.dbc.sample_assembly import CanMessage, MeasuredSignal
from drivers.decoders.dbc.settings import COLUMNS, TEMPERATURE, Settings, SignalSettings
from drivers.decoders.dbc.signal_bits import SignalCodec
from drivers.errors import ConfigError
from drivers.host import safe_file_reading
from drivers.host.extras import require_extra
from drivers.validation.module_lookup import format_suggestion

SHIPPED: Final = Path(drivers.__file__).parent.parent / "config" / "dbc"
SHIPPED_PREFIX: Final = "shipped:"
MAX_COUNTER_BITS: Final = 62
"""Maximum length of a counter in bits. A longer counter would overflow the int64 array of ticks."""


class ConfiguredDbcMessages:
    """Messages and signals that the settings select from a DBC file.

    Parameters
    ----------
    settings
        Settings of the decoder.

    Raises
    ------
    ConfigError
        If the settings contain mistakes. The error has one line for each mistake.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._errors: list[str] = []
        self._used: dict[str, CanMessage] = {}
        self.units: dict[str, str] = {}
        """Unit of each axis."""
        self.timing: Timing = ArrivalTimedFormat()
        """Timing of the samples."""
        with self._collecting():
            self._path = _locate(settings.file)
            self._messages: dict[str, Any] = {m.name: m for m in _load(self._path).messages}
            self._find_configured_signals()
        if self._errors:
            raise ConfigError(*self._errors)

    @property
    def messages_with_configured_signals(self) -> list[CanMessage]:
        """CAN messages with the configured signals. A message that contains only the counter comes first."""
        return sorted(self._used.values(), key=lambda m: not m.contains_only_counter)

    @contextlib.contextmanager
    def _collecting(self) -> Iterator[None]:
        """Collect the lines of a ConfigError instead of raising the error, so that all mistakes are reported."""
        try:
            yield
        except ConfigError as error:
            self._errors += error.mistake_lines

    def _find_configured_signals(self) -> None:
        s = self._settings
        for axis, entry in s.signals.items():
            with self._collecting():
                self._add_axis(axis, entry)
        if s.valid:
            with self._collecting():
                message, signal = self._find_signal("valid", s.valid)
                bits = self._signal_bits(message, signal)
                self._register_message(message, bits).valid = bits
        if s.counter:
            with self._collecting():
                self._add_counter()

    def _add_counter(self) -> None:
        s = self._settings
        for message, signal in self._find_counters():
            if signal.is_float or signal.length > MAX_COUNTER_BITS:
                raise ConfigError(
                    f'counter: "{s.counter}"; a counter is a whole number of at most {MAX_COUNTER_BITS} bits'
                )
            bits = self._signal_bits(message, signal)
            self._register_message(message, bits).counter = bits
            self.timing = CounterTimedFormat(1 << int(signal.length), s.tick)

    def _find_counters(self) -> list[tuple[Any, Any]]:
        name = self._settings.counter
        if "." in name or self._settings.join == "time":
            return [self._find_signal("counter", name)]
        # Only messages with inertial measurements need a counter.
        inertial = [m.name for m in self._used.values() if not m.contains_only_temperature]
        return [self._find_signal("counter", f"{message}.{name}") for message in inertial]

    def _add_axis(self, axis: str, entry: SignalSettings) -> None:
        message, signal = self._find_signal(f"signals.{axis}", entry.signal)
        factor, offset = self._conversion_to_si(axis, entry, signal)
        bits = self._signal_bits(message, signal)
        column = MeasuredSignal(COLUMNS.index(axis), bits, factor, offset)
        self._register_message(message, bits).columns.append(column)

    def _conversion_to_si(self, axis: str, entry: SignalSettings, signal: Any) -> tuple[float, float]:
        unit = entry.unit or signal.unit or ""
        try:
            if axis == TEMPERATURE:
                factor, offset = units.temperature_factor_and_offset(unit)
            else:
                look_up = units.angular_rate_factor if axis.startswith("g") else units.acceleration_factor
                factor, offset = look_up(unit), 0.0
                self.units[axis] = unit
        except ConfigError as error:
            where = "" if entry.unit else f" (the unit in {self._path.name})"
            counts = f'{axis} = {{ signal = "{entry.signal}", unit = "…", factor = 0.0305 }}'
            raise ConfigError(
                f"signals.{axis}: {error}{where}; name the unit, and for raw counts the size of a count: {counts}"
            ) from error
        return factor * entry.factor, offset * entry.factor

    def _find_signal(self, key: str, name: str) -> tuple[Any, Any]:
        message_name, dot, signal_name = name.partition(".")
        if not dot:
            hint = ', or with join = "counter" a bare name' if key == "counter" else ""
            raise ConfigError(f'{key}: "{name}"; it is "Message.Signal"{hint}')
        message = self._messages.get(message_name)
        if message is None:
            known = format_suggestion(message_name, tuple(self._messages))
            raise ConfigError(f'{key}: {self._path.name} has no message "{message_name}"{known}')
        signals = {one.name: one for one in message.signals}
        signal = signals.get(signal_name)
        if signal is None:
            known = format_suggestion(signal_name, tuple(signals))
            raise ConfigError(f'{key}: message {message_name} has no signal "{signal_name}"{known}')
        if signal.multiplexer_ids:
            raise ConfigError(f"{key}: {name} is multiplexed; such signals are not supported")
        return message, signal

    def _register_message(self, message: Any, bits: SignalCodec) -> CanMessage:
        """Return the entry of a CAN message, and create it if necessary. Increase ``size`` to include the signal."""
        extended, j1939 = bool(message.is_extended_frame), self._is_j1939(message)
        new = CanMessage(message.name, message.frame_id, extended, j1939, size=0, length=message.length, columns=[])
        entry = self._used.setdefault(message.name, new)
        entry.size = max(entry.size, bits.end_byte)
        return entry

    def _is_j1939(self, message: Any) -> bool:
        s = self._settings
        return bool(message.protocol == "j1939" if s.j1939 is None else s.j1939)

    def _signal_bits(self, message: Any, signal: Any) -> SignalCodec:
        s = self._settings
        big_endian = signal.byte_order == "big_endian"
        # For a Motorola signal, a DBC file states the most significant bit and numbers the bits of a byte from 7 to 0.
        first = 8 * (signal.start // 8) + 7 - signal.start % 8 if big_endian else signal.start
        if first < 0 or first + signal.length > 8 * message.length or not 0 < signal.length <= 64:
            raise ConfigError(f"{self._path.name}: {signal.name} does not fit in {message.name}")
        if signal.is_float and signal.length not in (16, 32, 64):
            raise ConfigError(
                f"{self._path.name}: {signal.name} is a float of {signal.length} bits; expected 16, 32 or 64"
            )
        if not (isfinite(signal.scale) and isfinite(signal.offset) and signal.scale):
            raise ConfigError(
                f"{self._path.name}: {signal.name} has factor {signal.scale:g} and offset {signal.offset:g}; both must "
                f"be finite, and the factor must not be 0"
            )
        not_available = self._is_j1939(message) if s.not_available is None else s.not_available
        return SignalCodec(
            first,
            signal.length,
            big_endian,
            bool(signal.is_signed),
            bool(signal.is_float),
            float(signal.scale),
            float(signal.offset),
            indicators=not_available and signal.length >= 8 and not signal.is_signed and not signal.is_float,
        )


def _locate(file: str) -> Path:
    """Return the path of a DBC file. A name without a folder may refer to a DBC file that is part of the project."""
    path = safe_file_reading.expand_user(file)
    name = file.removeprefix(SHIPPED_PREFIX)
    if name == file and (safe_file_reading.is_file(path) or len(path.parts) != 1):
        return path
    shipped: Mapping[str, Path] = {p.stem: p for p in sorted(SHIPPED.glob("*.dbc"))}
    stem = name.removesuffix(".dbc")
    if stem not in shipped:
        raise ConfigError(f'file: "{file}": no such file, and none shipped{format_suggestion(stem, tuple(shipped))}')
    return shipped[stem]


def _load(path: Path) -> Any:
    """Read a DBC file without strict checks, since unused signals overlap in many DBC files."""
    require_extra("can", "a CAN database")
    import cantools

    try:
        if path.suffix.lower() != ".dbc":
            safe_file_reading.read_small_file(path)  # check that the file is readable, since cantools opens it again
            return cantools.database.load_file(path, strict=False)
        return cantools.database.load_string(_text(path), "dbc", strict=False)
    except OSError as error:
        raise ConfigError(f"file: {path}: cannot be read: {error.strerror}") from error
    except (cantools.Error, ValueError, LookupError) as error:
        raise ConfigError(f"file: {path}: no CAN database: {' '.join(str(error).split())[:200]}") from error


def _text(path: Path) -> str:
    """Return the text of a DBC file, which is encoded in UTF-8 or in the Windows code page 1252."""
    data = safe_file_reading.read_small_file(path)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", errors="replace")
