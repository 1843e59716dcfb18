"""Base class of the settings in a configuration file, and validation of one table of a configuration file.

Each field of a settings model describes one key with its type, supported range, default and description. A field
without a default, or with a default that disables a feature, also has an example. ``check_table`` finds all mistakes in
a table.
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

from drivers.errors import ConfigError
from drivers.host import safe_file_reading
from drivers.validation.module_lookup import format_choices_by_similarity, format_suggestion
from drivers.validation.number_ranges import format_value

MAX_PASSES: Final = 4
"""Maximum number of times that a table is validated. Invalid values are replaced after each validation."""
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
"""Description of the expected value for each type of pydantic error."""

T = TypeVar("T")
Model = TypeVar("Model", bound="SettingsModel")


class Conflict(NamedTuple):
    """Mistake in the combination of several configuration keys."""

    key: str  # key in the error message; "" for the whole table
    text: str
    others: tuple[str, ...] = ()  # other keys that are part of the mistake


@dataclass(frozen=True, slots=True)
class _ReadContext:
    """Context of a validation by ``check_table``. Settings that Python code creates are validated without a context."""

    folder: Path | None  # folder of the configuration file; None if the existence of files is not checked


class SettingsModel(BaseModel):
    """Base class of all settings. Unknown keys are errors, and values are not converted to other types."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", validate_by_name=True)

    def find_conflicting_settings(self) -> Iterator[Conflict]:
        """Yield the mistakes in the combination of keys."""
        return iter(())

    @model_validator(mode="after")
    def _refuse_conflicts(self, info: ValidationInfo) -> Self:
        if info.context is None and (
            found := list(self.find_conflicting_settings())
        ):  # otherwise check_table adds them
            raise ConfigError(*(f"{one.key}: {one.text}" for one in found))
        return self


class Problem(NamedTuple):
    """Mistake in a configuration table."""

    key_path: str  # path of the key, such as "signals.gx" or "tau[1]"; "" for the whole table
    text: str

    def nest_under(self, table_path: str) -> "Problem":
        """Return the same problem with ``table_path`` prepended to the key path."""
        dot = "." if table_path and self.key_path and not self.key_path.startswith("[") else ""
        return Problem(f"{table_path}{dot}{self.key_path}", self.text)

    def __str__(self) -> str:
        return f"{self.key_path}: {self.text}" if self.key_path else self.text


class TableError(ConfigError):
    """Mistakes in a configuration table that is not converted to a settings model.

    Parameters
    ----------
    problems
        Mistakes, with the paths of the keys in the table.
    partial
        Object with the valid parts of the table, for further checks.
    """

    def __init__(self, problems: Sequence[Problem], partial: object = None) -> None:
        super().__init__(*map(str, problems))
        self.problems = problems
        self.partial = partial


@dataclass
class TableCheckResult(Generic[Model]):
    """Result of ``check_table``."""

    value: Model | None  # settings with replaced invalid values; None if no replacement is possible
    problems: list[Problem] = field(default_factory=list)
    partial: dict[str, object] = field(default_factory=dict)  # ``TableError.partial`` for each table path

    def has_no_problem(self, *key_paths: str) -> bool:
        """Return True if no problem was found in the given keys, their parent tables and their subkeys."""
        return not any(_nested(key_path, wrong.key_path) for key_path in key_paths for wrong in self.problems)

    def add_problem(self, key_path: str, text: str) -> None:
        """Add a problem unless the key already has a problem.

        Parameters
        ----------
        key_path
            Path of the key in the configuration file.
        text
            Message.
        """
        if self.has_no_problem(key_path):
            self.problems.append(Problem(key_path, text))


def check_table(model: type[Model], table: Mapping[str, Any], folder: Path | None = None) -> TableCheckResult[Model]:
    """Convert a configuration table to settings, and find all mistakes in the table.

    Invalid values are replaced with defaults or examples, so that the remaining values can be checked.

    Parameters
    ----------
    model
        Settings model of the table.
    table
        Keys and values from a TOML file.
    folder
        Folder to which relative paths refer. None skips the check that files exist.
    """
    checked: TableCheckResult[Model] = TableCheckResult(None)
    repaired = copy.deepcopy(dict(table))
    for _ in range(MAX_PASSES):
        try:
            checked.value = model.model_validate(repaired, context=_ReadContext(folder), by_alias=True, by_name=False)
        except ValidationError as error:
            details = error.errors(include_url=False)
            found = [problem for one in details for problem in _problems(model, one, checked)]
            checked.problems += [one for one in found if checked.has_no_problem(one.key_path)]
            for one in reversed(details):
                _repair(model, repaired, one)
        else:
            _add_conflicts(checked, checked.value, "")
            break
    return checked


def fields_by_key(model: type[SettingsModel]) -> dict[str, FieldInfo]:
    """Return the fields of a settings model. The dictionary keys are the keys in the configuration file."""
    return {found.alias or name: found for name, found in model.model_fields.items()}


def find_settings_model(annotation: Any) -> type[SettingsModel] | None:
    """Return the settings model in a type annotation, or None if the annotation contains no settings model."""
    if isinstance(annotation, type) and issubclass(annotation, SettingsModel):
        return annotation
    return next((found for one in get_args(annotation) if (found := find_settings_model(one))), None)


def _problems(kind: type[SettingsModel], error: ErrorDetails, checked: TableCheckResult[Any]) -> Iterator[Problem]:
    key_path = _format_location(error["loc"])
    cause = error.get("ctx", {}).get("error")
    if isinstance(cause, TableError):
        checked.partial[key_path] = cause.partial
        yield from (problem.nest_under(key_path) for problem in cause.problems)
    elif isinstance(cause, ConfigError):
        yield from (Problem(key_path, line) for line in cause.mistake_lines)
    elif error["type"] == "extra_forbidden":
        model = _field_at(kind, error["loc"])[0]
        yield Problem(key_path, f"unknown key{format_suggestion(str(error['loc'][-1]), tuple(fields_by_key(model)))}")
    else:
        yield Problem(key_path, _describe(error))


def _describe(error: ErrorDetails) -> str:
    value = error["input"]
    if error["type"] == "missing":
        return "missing"
    if error["type"] == "literal_error":
        words = [word or number for word, number in re.findall(r"'([^']*)'|(\d+)", error["ctx"]["expected"])]
        return f"{format_value(value)}{format_choices_by_similarity(str(value), words)}"
    return f"expected {EXPECTED.get(error['type'], 'another value')}, got {format_value(value)}"


def _add_conflicts(checked: TableCheckResult[Any], value: object, key_path: str) -> None:
    if isinstance(value, SettingsModel):
        for one in value.find_conflicting_settings():
            problem = Problem(one.key, one.text).nest_under(key_path)
            keys = (*one.others, one.key) if one.key else one.others
            if checked.has_no_problem(*(Problem(key, "").nest_under(key_path).key_path for key in keys)):
                checked.problems.append(problem)
        for key, info in zip(fields_by_key(type(value)), type(value).model_fields, strict=True):
            _add_conflicts(checked, getattr(value, info), Problem(key, "").nest_under(key_path).key_path)
    elif isinstance(value, tuple):
        for i, one in enumerate(value):
            _add_conflicts(checked, one, f"{key_path}[{i}]")


def _repair(kind: type[SettingsModel], table: Any, error: ErrorDetails) -> None:
    *path, last = [part for part in error["loc"] if part != "[key]"]
    found = _field_at(kind, error["loc"])[1]
    with contextlib.suppress(LookupError):  # an earlier replacement may have removed the value
        for part in path:
            table = table[part]
        if error["type"] == "model_type":
            table[last] = {}
        elif error["type"] == "missing" and found is not None and found.examples:
            table[last] = found.examples[0]
        elif error["type"] != "missing":
            del table[last]


def _field_at(kind: type[SettingsModel], location: Sequence[str | int]) -> tuple[type[SettingsModel], FieldInfo | None]:
    """Return the settings model that contains the last key of a path, and the field of this key.

    The field is None for an unknown key.
    """
    found = None
    for part in location:
        if found is not None:
            kind = find_settings_model(found.annotation) or kind
        if isinstance(part, str):
            found = fields_by_key(kind).get(part)
    return kind, found


def _format_location(location: Sequence[str | int]) -> str:
    """Format the location of a pydantic error as a key path.

    >>> _format_location(("device", 0, "tau", 1)), _format_location(("scale", "gw", "[key]"))
    ('device[0].tau[1]', 'scale.gw')
    """
    parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in location if part != "[key]")
    return "".join(parts).removeprefix(".")


def _nested(one: str, other: str) -> bool:
    """Return True if two key paths are equal, or if one path lies within the table or list of the other path."""
    short, long = sorted((one, other), key=len)
    return short == long or (bool(short) and long.startswith(short) and long[len(short)] in ".[")


# --- field types


ListOf = Annotated[tuple[T, ...], Strict(False)]
"""Tuple that is written as a list in the configuration file. The items are not converted to other types."""


class ConvertedFrom:
    """Annotation of a field whose value has another type in the configuration file.

    Parameters
    ----------
    kind
        Type of the value in the configuration file.
    convert
        Function that converts a value. The arguments are the value and the folder of the configuration file, which is
        None if there is no file. The function raises ConfigError if the value is invalid.
    """

    def __init__(self, kind: Any, convert: Callable[[Any, Path | None], Any]) -> None:
        self._kind = kind
        self._convert = convert

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return a pydantic schema that validates and converts a value."""
        converted = get_origin(source) or source

        def convert_value(value: Any, validate: Callable[[Any], Any], info: ValidationInfo) -> Any:
            if info.context is None and isinstance(value, converted):
                return value
            return self._convert(validate(value), info.context.folder if info.context else None)

        return core_schema.with_info_wrap_validator_function(convert_value, handler.generate_schema(self._kind))


class KeywordOrType:
    """Annotation of a field that accepts keywords, such as "auto", as well as values of a type.

    Parameters
    ----------
    words
        Mapping from each keyword to its value.
    kind
        Type of all other values.
    """

    def __init__(self, words: Mapping[str, Any], kind: Any) -> None:
        self._words = words
        self._kind = kind

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return a pydantic schema that replaces keywords and validates all other values."""

        def replace_keyword(value: Any, validate: Callable[[Any], Any], info: ValidationInfo) -> Any:
            if isinstance(value, str) and value in self._words:
                return self._words[value]
            if info.context is None and value in self._words.values():
                return value
            try:
                return validate(value)
            except ValidationError as error:
                (first, *_) = error.errors(include_url=False)
                if first["loc"]:  # a list item is invalid, and the error describes the item
                    raise
                raise ConfigError(self._describe(value, first)) from None

        return core_schema.with_info_wrap_validator_function(replace_keyword, handler.generate_schema(self._kind))

    def _describe(self, value: object, error: ErrorDetails) -> str:
        cause = error.get("ctx", {}).get("error")
        text = str(cause) if isinstance(cause, ConfigError) else _describe(error)
        near = format_choices_by_similarity(str(value), tuple(self._words)).partition("are ")[2].split(", ")
        words = ", ".join(f'"{word}"' for word in near)
        if text.startswith("expected "):
            return f"expected {words} or {text.removeprefix('expected ')}"
        return f"{text}, or {words}"


def one_of(words: Sequence[str]) -> AfterValidator:
    """Return a pydantic validator that accepts only the given words."""

    def check_is_listed_choice(value: str) -> str:
        if value not in words:
            raise ConfigError(f'"{value}"{format_choices_by_similarity(value, words)}')
        return value

    return AfterValidator(check_is_listed_choice)


def checked_by(check: Callable[[T], object]) -> AfterValidator:
    """Return a pydantic validator that calls ``check`` and leaves the value unchanged."""

    def validate(value: T) -> T:
        check(value)
        return value

    return AfterValidator(validate)


def _existing_file(value: str, info: ValidationInfo) -> str:
    path = _beside(value, info)
    if path is not None and not os.path.exists(path):  # Path.exists would raise an error for an invalid name
        raise ConfigError(f"{path}: no such file")
    return value if path is None else str(path)


def _file_or_name(value: str, info: ValidationInfo) -> str:
    """Return the path if the file exists; otherwise return the text unchanged."""
    path = _beside(value, info)
    return value if path is None or not os.path.exists(path) else str(path)


def _beside(value: str, info: ValidationInfo) -> Path | None:
    """Return the path relative to the configuration file, or None if the value is empty or there is no such file."""
    folder = info.context.folder if info.context else None
    return folder / safe_file_reading.expand_user(value) if folder and value else None


FilePath = Annotated[str, AfterValidator(_existing_file)]
"""Path of an existing file, absolute or relative to the folder of the configuration file."""
FileOrName = Annotated[str, AfterValidator(_file_or_name)]
"""Path of a file, or name of a file that is part of the program."""
