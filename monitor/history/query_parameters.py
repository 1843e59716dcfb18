"""Query of the stored results of a device, given as the parameters of a zenoh selector (request address).

Examples of parameters are ``_time=[…]`` (default: the last day), ``step=15min``,
``what=coefficients,deviations,status,events``, ``axis=gz,gx`` and ``letter=N,B``. Other parameters that begin with
``_`` are reserved for zenoh and ignored. An unknown parameter raises ConfigError.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from drivers.data_types import AXES
from drivers.errors import ConfigError
from drivers.module_lookup import format_suggestion
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS
from monitor.history.minute_aggregation import HEALTH_COLUMNS, TEMPERATURE_COLUMNS
from monitor.history.time_ranges import TimeRange, parse_duration_s, parse_zenoh_range

COEFFICIENTS: Final = "coefficients"
DEVIATIONS: Final = "deviations"
STATUS: Final = "status"
EVENTS: Final = "events"
PARTS: Final = (COEFFICIENTS, DEVIATIONS, STATUS, EVENTS)
DEFAULT_PARTS: Final = (COEFFICIENTS, STATUS, EVENTS)
"""Parts of the results that are returned by default. Allan deviations would be larger than all other parts together."""
PARAMETER_NAMES: Final = ("_time", "step", "what", "axis", "letter")
MAX_PARAMETERS_LENGTH: Final = 1000
"""Maximum length of the parameter string in characters."""
_PART: Final = re.compile(r"([^=;]+)(?:=((?:[\[\]][^\[\]]*[\[\]])|[^;]*))?(?:;|$)")


@dataclass(frozen=True, slots=True)
class HistoryQuery:
    """Query of stored results by time range, width of the time buckets, parts, axes and coefficients."""

    span: TimeRange | None = None  # None means the last stored day
    step_s: int | None = None  # width of the time buckets; None means chosen automatically
    what: tuple[str, ...] = DEFAULT_PARTS
    axes: tuple[str, ...] = AXES
    symbols: tuple[str, ...] = SYMBOLS

    def selects_column(self, name: str) -> bool:
        """Return True if the query selects the column ``name``.

        >>> query = HistoryQuery(axes=("gz",))
        >>> query.selects_column("gz.N.lo"), query.selects_column("gx.N"), HistoryQuery().selects_column("rate")
        (True, False, True)
        """
        axis, _, rest = name.partition(".")
        if not rest:
            return STATUS in self.what and name in (*HEALTH_COLUMNS, *TEMPERATURE_COLUMNS)
        if axis not in self.axes:
            return False
        symbol = rest.split(".")[0]
        return DEVIATIONS in self.what if symbol == "sigma" else COEFFICIENTS in self.what and symbol in self.symbols

    def format_parameters(self) -> str:
        """Format the query as the parameters of a zenoh selector.

        >>> day = TimeRange(0.0, 86400.0, end_included=False)
        >>> HistoryQuery(day, 900, ("status",), ("gz",)).format_parameters()
        '_time=[1970-01-01T00:00:00.000000Z..1970-01-02T00:00:00.000000Z[;step=900s;what=status;axis=gz;letter=Q,N,B,K,R'
        """
        parts = {
            "_time": "" if self.span is None else self.span.format_for_zenoh(),
            "step": "" if self.step_s is None else f"{self.step_s}s",
            "what": ",".join(self.what),
            "axis": ",".join(self.axes),
            "letter": ",".join(self.symbols),
        }
        return ";".join(f"{key}={value}" for key, value in parts.items() if value)


def parse_query(parameters: str, now_s: float) -> HistoryQuery:
    """Parse the parameters of a zenoh selector.

    >>> parse_query("_time=[now(-2h);30m];axis=gz;what=coefficients", 7200.0).span
    TimeRange(start_s=0.0, end_s=1800.0, start_included=True, end_included=True)

    Parameters
    ----------
    parameters
        Parameters of the selector, separated by semicolons.
    now_s
        Current Unix time [s].

    Raises
    ------
    ConfigError
        If a parameter is unknown or has an invalid value.
    """
    given = _split(parameters)
    for key in given:
        if key not in PARAMETER_NAMES and not key.startswith("_"):
            raise ConfigError(f'"{key[:40]}": unknown parameter{format_suggestion(key, PARAMETER_NAMES)}')
    step_s = parse_duration_s(given["step"]) if given.get("step") else None
    if step_s is not None and not 1.0 <= step_s <= 1e10:
        raise ConfigError(f"step: {step_s:g} s; possible are 1 s and more")
    return HistoryQuery(
        parse_zenoh_range(given["_time"], now_s) if given.get("_time") else None,
        None if step_s is None else int(step_s),
        _parse_list("what", given.get("what", ""), PARTS) or DEFAULT_PARTS,
        _parse_list("axis", given.get("axis", ""), AXES) or AXES,
        _parse_list("letter", given.get("letter", ""), SYMBOLS) or SYMBOLS,
    )


def _split(parameters: str) -> Mapping[str, str]:
    """Split a parameter string into keys and values at semicolons that are not inside the brackets of a time range."""
    if len(parameters) > MAX_PARAMETERS_LENGTH:
        raise ConfigError(f"parameters of {len(parameters)} characters; at most {MAX_PARAMETERS_LENGTH}")
    return {key.strip(): (value or "").strip() for key, value in _PART.findall(parameters)}


def _parse_list(key: str, text: str, known: tuple[str, ...]) -> tuple[str, ...]:
    words = [word.strip() for word in text.split(",") if word.strip()]
    for word in words:
        if word not in known:
            raise ConfigError(f'{key}: "{word[:40]}"{format_suggestion(word, known)}')
    return tuple(one for one in known if one in words)
