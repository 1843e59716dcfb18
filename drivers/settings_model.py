"""Base class of the settings that are read from a configuration file, and the reader of one table of such a file.

Each field of a model describes one key: its type with the supported range, its default, and its description. A field
without a default, or with a default that turns a function off, also has an example. ``check_table`` finds all mistakes
of a table at once. Each mistake is described in plain words, without names of Python types.
"""

import contextlib
import copy
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, Generic, NamedTuple, Self, TypeVar, get_args, get_origin

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    GetCoreSchemaHandler,
    Strict,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema, ErrorDetails, core_schema

from drivers import file_access
from drivers.discovery import format_choices, format_suggestion
from drivers.errors import ConfigError
from drivers.number_ranges import format_value

MAX_PASSES: Final = 4
"""Maximum number of validations of a table. Each pass replaces the wrong values that the previous pass has found."""
EXPECTED: Final = {
    "float_type": "a number",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "string_type": "text in quotes",
    "list_type": "a list",
    "tuple_type": "a list",
    "frozen_set_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
}
"""Description of the expected value, by type of a pydantic error."""

T = TypeVar("T")
Model = TypeVar("Model", bound="SettingsModel")


class Conflict(NamedTuple):
    """Mistake that concerns several keys of a table, or a key together with another part of the file."""

    key: str  # key that the message names; "" for the whole table
    text: str
    others: tuple[str, ...] = ()  # further keys that the message depends on


@dataclass(frozen=True, slots=True)
class ReadContext:
    """Context of the validation of a table from a file. Settings that Python code creates have no context."""

    folder: Path | None  # folder of the configuration file; None if the existence of files is not checked


class SettingsModel(BaseModel):
    """Base class of all settings. Unknown keys are mistakes, and values are not converted to other types."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", validate_by_name=True)

    def find_conflicts(self) -> Iterator[Conflict]:
        """Yield the mistakes that a single field does not show."""
        return iter(())

    @model_validator(mode="after")
    def _refuse_conflicts(self, info: ValidationInfo) -> Self:
        if info.context is None and (found := list(self.find_conflicts())):  # check_table collects them itself
            raise ConfigError(*(f"{one.key}: {one.text}" for one in found))
        return self


class Problem(NamedTuple):
    """Mistake in a table."""

    place: str  # path of the key, such as "signals.gx" or "tau[1]"; "" for the whole table
    text: str

    def nest_under(self, place: str) -> "Problem":
        """Return the same problem for a table at ``place`` of a larger table."""
        dot = "." if place and self.place and not self.place.startswith("[") else ""
        return Problem(f"{place}{dot}{self.place}", self.text)

    def __str__(self) -> str:
        return f"{self.place}: {self.text}" if self.place else self.text


class TableError(ConfigError):
    """Mistakes in a table that a field converts to an object.

    Parameters
    ----------
    problems
        Mistakes with their places in the table.
    partial
        Part of the object that can be checked further.
    """

    def __init__(self, problems: Sequence[Problem], partial: object = None) -> None:
        super().__init__(*map(str, problems))
        self.problems = problems
        self.partial = partial


@dataclass
class TableCheckResult(Generic[Model]):
    """Result of ``check_table``."""

    value: Model | None  # settings, with defaults or examples in place of wrong values; None if that is impossible
    problems: list[Problem] = field(default_factory=list)
    partial: dict[str, object] = field(default_factory=dict)  # partial objects of wrong tables, by place

    def is_sound(self, *places: str) -> bool:
        """Return True if no problem was found in these keys, in their tables or in their subkeys."""
        return not any(_nested(place, wrong.place) for place in places for wrong in self.problems)

    def add_problem(self, place: str, text: str) -> None:
        """Add a problem, unless the value at its place is wrong by itself.

        Parameters
        ----------
        place
            Path of the key that the message names.
        text
            Message.
        """
        if self.is_sound(place):
            self.problems.append(Problem(place, text))


def read_settings(kind: type[Model], table: Mapping[str, Any], folder: Path | None = None) -> Model:
    """Return the settings of a table.

    Parameters
    ----------
    kind
        Model of the table.
    table
        Keys and values, as TOML gives them.
    folder
        Folder at which relative paths begin. If it is None, files are not looked for.

    Raises
    ------
    ConfigError
        If the table has mistakes. There is one line for each mistake.
    """
    checked = check_table(kind, table, folder)
    if checked.problems or checked.value is None:
        raise ConfigError(*map(str, checked.problems))
    return checked.value


def check_table(kind: type[Model], table: Mapping[str, Any], folder: Path | None = None) -> TableCheckResult[Model]:
    """Find all mistakes of a table.

    Wrong values are replaced by defaults or examples, so that they do not hide other mistakes.

    Parameters
    ----------
    kind
        Model of the table.
    table
        Keys and values, as TOML gives them.
    folder
        Folder at which relative paths begin. If it is None, files are not looked for.
    """
    checked: TableCheckResult[Model] = TableCheckResult(None)
    repaired = copy.deepcopy(dict(table))
    for _ in range(MAX_PASSES):
        try:
            checked.value = kind.model_validate(repaired, context=ReadContext(folder), by_alias=True, by_name=False)
        except ValidationError as error:
            details = error.errors(include_url=False)
            found = [problem for one in details for problem in _problems(kind, one, checked)]
            checked.problems += [one for one in found if checked.is_sound(one.place)]
            for one in reversed(details):
                _repair(kind, repaired, one)
        else:
            _add_conflicts(checked, checked.value, "")
            break
    return checked


def fields_by_key(kind: type[SettingsModel]) -> dict[str, FieldInfo]:
    """Return the fields of a model by the names of their keys in the file."""
    return {found.alias or name: found for name, found in kind.model_fields.items()}


def find_model(annotation: Any) -> type[SettingsModel] | None:
    """Return the settings model within the type of a field; None if there is none."""
    if isinstance(annotation, type) and issubclass(annotation, SettingsModel):
        return annotation
    return next((found for one in get_args(annotation) if (found := find_model(one))), None)


def _problems(kind: type[SettingsModel], error: ErrorDetails, checked: TableCheckResult[Any]) -> Iterator[Problem]:
    """Yield the problems that an error of pydantic stands for."""
    place = _format_place(error["loc"])
    cause = error.get("ctx", {}).get("error")
    if isinstance(cause, TableError):
        checked.partial[place] = cause.partial
        yield from (problem.nest_under(place) for problem in cause.problems)
    elif isinstance(cause, ConfigError):
        yield from (Problem(place, line) for line in cause.lines)
    elif error["type"] == "extra_forbidden":
        model = _field_at(kind, error["loc"])[0]
        yield Problem(place, f"unknown key{format_suggestion(str(error['loc'][-1]), tuple(fields_by_key(model)))}")
    else:
        yield Problem(place, _describe(error))


def _describe(error: ErrorDetails) -> str:
    """Describe a wrong value in plain words."""
    value = error["input"]
    if error["type"] == "missing":
        return "missing"
    if error["type"] == "literal_error":
        words = [word or number for word, number in re.findall(r"'([^']*)'|(\d+)", error["ctx"]["expected"])]
        return f"{format_value(value)}{format_choices(str(value), words)}"
    return f"expected {EXPECTED.get(error['type'], 'another value')}, got {format_value(value)}"


def _add_conflicts(checked: TableCheckResult[Any], value: object, place: str) -> None:
    """Add the conflicts of a model and of all models in it."""
    if isinstance(value, SettingsModel):
        for one in value.find_conflicts():
            problem = Problem(one.key, one.text).nest_under(place)
            keys = (*one.others, one.key) if one.key else one.others
            if checked.is_sound(*(Problem(key, "").nest_under(place).place for key in keys)):
                checked.problems.append(problem)
        for key, info in zip(fields_by_key(type(value)), type(value).model_fields, strict=True):
            _add_conflicts(checked, getattr(value, info), Problem(key, "").nest_under(place).place)
    elif isinstance(value, tuple):
        for i, one in enumerate(value):
            _add_conflicts(checked, one, f"{place}[{i}]")


def _repair(kind: type[SettingsModel], table: Any, error: ErrorDetails) -> None:
    """Replace a wrong or missing value so that the rest of the table can be checked."""
    *path, last = [part for part in error["loc"] if part != "[key]"]
    found = _field_at(kind, error["loc"])[1]
    with contextlib.suppress(LookupError):  # the repair of another error at this place has removed the value
        for part in path:
            table = table[part]
        if error["type"] == "model_type":
            table[last] = {}
        elif error["type"] == "missing" and found is not None and found.examples:
            table[last] = found.examples[0]
        elif error["type"] != "missing":
            del table[last]


def _field_at(kind: type[SettingsModel], place: Sequence[str | int]) -> tuple[type[SettingsModel], FieldInfo | None]:
    """Return the innermost model at a place, and the field of the last key; None if the model does not have the key."""
    found = None
    for part in place:
        if found is not None:
            kind = find_model(found.annotation) or kind
        if isinstance(part, str):
            found = fields_by_key(kind).get(part)
    return kind, found


def _format_place(place: Sequence[str | int]) -> str:
    """Return a place as a path of keys.

    >>> _format_place(("device", 0, "tau", 1)), _format_place(("scale", "gw", "[key]"))
    ('device[0].tau[1]', 'scale.gw')
    """
    parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in place if part != "[key]")
    return "".join(parts).removeprefix(".")


def _nested(one: str, other: str) -> bool:
    """Return True if one of two places contains the other. The whole table counts as a place of its own."""
    short, long = sorted((one, other), key=len)
    return short == long or (bool(short) and long.startswith(short) and long[len(short)] in ".[")


# --- types of fields


ListOf = Annotated[tuple[T, ...], Strict(False)]
"""List in the file, tuple in the model. The items keep their strict types."""


class ReadAs:
    """Annotation of a field whose value in the file has another type than in the model.

    Parameters
    ----------
    kind
        Type of the value in the file.
    convert
        Function of the value and the folder of the file (None if there is no file). It returns the value of the model,
        and it raises ConfigError for a value that cannot be converted.
    """

    def __init__(self, kind: Any, convert: Callable[[Any, Path | None], Any]) -> None:
        self._kind = kind
        self._convert = convert

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return the schema of the value in the file, with the conversion after it."""
        converted = get_origin(source) or source

        def read(value: Any, inner: Callable[[Any], Any], info: ValidationInfo) -> Any:
            if info.context is None and isinstance(value, converted):
                return value
            return self._convert(inner(value), info.context.folder if info.context else None)

        return core_schema.with_info_wrap_validator_function(read, handler.generate_schema(self._kind))


class WordOr:
    """Annotation of a field that accepts words in addition to the values of a type.

    Parameters
    ----------
    words
        Words with the values that they stand for.
    kind
        Type of all other values.
    """

    def __init__(self, words: Mapping[str, Any], kind: Any) -> None:
        self._words = words
        self._kind = kind

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return the schema of the type, with the words before it."""

        def read(value: Any, inner: Callable[[Any], Any], info: ValidationInfo) -> Any:
            if isinstance(value, str) and value in self._words:
                return self._words[value]
            if info.context is None and value in self._words.values():
                return value
            try:
                return inner(value)
            except ValidationError as error:
                (first, *_) = error.errors(include_url=False)
                if first["loc"]:  # an element is wrong, and its own message describes it
                    raise
                raise ConfigError(self._describe(value, first)) from None

        return core_schema.with_info_wrap_validator_function(read, handler.generate_schema(self._kind))

    def _describe(self, value: object, error: ErrorDetails) -> str:
        """Describe a value that is neither a word nor of the type."""
        cause = error.get("ctx", {}).get("error")
        text = str(cause) if isinstance(cause, ConfigError) else _describe(error)
        near = format_choices(str(value), tuple(self._words)).partition("are ")[2].split(", ")
        words = ", ".join(f'"{word}"' for word in near)
        if text.startswith("expected "):
            return f"expected {words} or {text.removeprefix('expected ')}"
        return f"{text}, or {words}"


def one_of(words: Sequence[str]) -> AfterValidator:
    """Return a validator for a text that must be one of several words."""

    def check(value: str) -> str:
        if value not in words:
            raise ConfigError(f'"{value}"{format_choices(value, words)}')
        return value

    return AfterValidator(check)


def checked_by(check: Callable[[T], object]) -> AfterValidator:
    """Return a validator that keeps the value, and that reports the ConfigError of a function."""

    def validate(value: T) -> T:
        check(value)
        return value

    return AfterValidator(validate)


def _existing_file(value: str, info: ValidationInfo) -> str:
    """Return the path of a file that must exist."""
    path = _beside(value, info)
    if path is not None and not os.path.exists(path):  # False for a name that no file can have
        raise ConfigError(f"{path}: no such file")
    return value if path is None else str(path)


def _file_or_name(value: str, info: ValidationInfo) -> str:
    """Return the path of a file if it exists, otherwise the text."""
    path = _beside(value, info)
    return value if path is None or not os.path.exists(path) else str(path)


def _beside(value: str, info: ValidationInfo) -> Path | None:
    """Return the path relative to the configuration file; None for an empty value or without a file."""
    folder = info.context.folder if info.context else None
    return folder / file_access.expand_user(value) if folder and value else None


FilePath = Annotated[str, AfterValidator(_existing_file)]
"""Path of an existing file. A relative path begins at the folder of the configuration file."""
FileOrName = Annotated[str, AfterValidator(_file_or_name)]
"""Path of a file beside the configuration file, or name of something that is shipped with the program."""
