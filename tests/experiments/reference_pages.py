"""Write the generated parts of the reference pages: ``python -m tests.experiments.reference_pages``.

A generated part stands between the comments ``<!-- generated: NAME -->`` and ``<!-- end -->``. The commands come from
the command line, the configuration keys from the settings models, the messages from the message classes, and the
layouts from the list that the tests use.
"""

import ast
import inspect
import re
import textwrap
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Final, get_args, get_origin

import msgspec
import typer

import drivers.decoders
import imu_monitor
from drivers.validation import module_lookup
from drivers.validation.settings_model import SettingsModel
from monitor.cli import app
from monitor.publishing.messages import results
from monitor.publishing.messages.message import Message
from monitor.settings import driver_settings
from monitor.settings.printed_defaults import FIRST_LINK, describe_keys, format_toml_value, list_tables
from tests.drivers.public_layouts import LAYOUTS

PAGES: Final = sorted((Path(__file__).resolve().parents[2] / "docs" / "reference").glob("*.md"))
PART: Final = re.compile(r"(<!-- generated: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
SHARED_BY: Final = 3
"""Minimum number of commands sharing an option for the option to be described only once."""
RECORDING_OPTIONS: Final = r"\| `--(topic|columns|\w+-unit|decoder|option) "
"""Rows of the options that all commands that read recordings have."""


def format_commands() -> str:
    """Describe each command with its arguments and options."""
    commands = dict(_commands(typer.main.get_command(app), ""))
    uses = Counter(_option_row(one) for command in commands.values() for one in _options(command))
    shared = [row for row, times in uses.items() if times >= SHARED_BY]
    for_recordings = [row for row in shared if re.match(RECORDING_OPTIONS, row)]
    shared = [row for row in shared if row not in for_recordings]
    parts = []
    for name, command in commands.items():
        arguments = [one for one in command.params if one.param_type_name == "argument"]
        usage = " ".join(["imu-monitor", name, *(_metavar(one) for one in arguments)])
        rows = [f"| `{_metavar(one)}` | {_sentence(getattr(one, 'help', None))} |" for one in arguments]
        own = [_option_row(one) for one in _options(command)]
        rows += [row for row in own if row not in shared and row not in for_recordings]
        common = [f"`{row.split('`')[1].split()[0]}`" for row in own if row in shared]
        common += ["[options for recordings](#options-for-recordings)"] if set(for_recordings) <= set(own) else []
        parts += [
            f"### `{name}`",
            f"```sh\n{usage}\n{_example(command, usage)}```",
            " ".join((command.help or "").split()),
        ]
        parts += [_table(("argument or option", "meaning"), rows)] if rows else []
        parts += [f"[Shared options](#shared-options): {', '.join(common)}."] if common else []
    for title, rows in (("Shared options", shared), ("Options for recordings", for_recordings)):
        parts += [f"### {title}", _table(("option", "meaning"), rows)]
    return "\n\n".join(parts)


def _commands(group: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from _commands(command, f"{prefix}{name} ")
        elif not command.hidden:
            yield f"{prefix}{name}", command


def _example(command: Any, usage: str) -> str:
    example = (command.epilog or usage).removeprefix("Example: ")
    return "" if example == usage else f"{example}    # example\n"


def _options(command: Any) -> list[Any]:
    options = [one for one in command.params if one.param_type_name == "option"]
    return [one for one in options if not one.hidden and one.name != "help"]


def _metavar(argument: Any) -> str:
    return str(argument.metavar or argument.name).strip("[]").replace("|", " or ")


def _option_row(option: Any) -> str:
    value = "" if option.is_flag else f" {option.metavar or ''}"
    default = "" if option.default in (None, False) or callable(option.default) else f" Default: `{option.default}`."
    required = " Required." if option.required else ""
    return f"| `{_cell(option.opts[0] + value)}` | {_cell(_sentence(option.help))}{required}{default} |"


def _sentence(text: str | None) -> str:
    return " ".join((text or "").split())


def _cell(text: str) -> str:
    return text.replace("|", r"\|")


def _table(heads: Iterable[str], rows: Iterable[str]) -> str:
    heads = tuple(heads)
    return "\n".join([f"| {' | '.join(heads)} |", f"|{' --- |' * len(heads)}", *rows])


def format_configuration() -> str:
    """Describe the keys of all tables of a configuration file."""
    parts = []
    for name, model in list_tables():
        parts += [
            f"### `{name}`",
            _key_table(_key_rows(model, ("driver", "axes", "limit") if name == "[[device]]" else ())),
        ]
    names = sorted(driver_settings.list_link_names(), key=lambda one: (one != FIRST_LINK, one))
    links = {name: _key_rows(driver_settings.link_settings_class(name), ("faults",)) for name in names}
    shared = [row for row in links[FIRST_LINK] if all(row in rows for rows in links.values())]
    parts += ["## Links", "Keys of every link:", _key_table(shared)]
    for name, rows in links.items():
        parts += [f'### `link = "{name}"`', _key_table(row for row in rows if row not in shared)]
    parts += [
        "### `[device.driver.faults]`",
        "Faults of a virtual sensor.",
        _key_table(_key_rows(driver_settings.FaultsTable)),
    ]
    parts += ["## Decoders", "These keys belong to the table `[device.driver.decoder_options]`."]
    decoders = {
        name: _key_rows(module_lookup.import_module(drivers.decoders, name).Settings)
        for name in module_lookup.list_modules(drivers.decoders)
    }
    without_keys = ", ".join(f"`{name}`" for name, rows in decoders.items() if not rows)
    parts.append(f"These decoders have no keys: {without_keys}.")
    for name, rows in decoders.items():
        parts += [f'### `decoder = "{name}"`', _key_table(rows)] if rows else []
    return "\n\n".join(parts)


def _key_rows(model: type[SettingsModel], omit: tuple[str, ...] = ()) -> list[str]:
    return [
        f"| `{key.name}` | {f'`{_cell(format_toml_value(key.value))}`' if key.has_default else ''} "
        f"| {'required; ' if key.required else ''}{_cell(key.description)} |"
        for key in describe_keys(model)
        if key.name not in omit
    ]


def _key_table(rows: Iterable[str]) -> str:
    return _table(("key", "default", "meaning"), rows)


def format_messages() -> str:
    """Describe the fields of each message."""
    parts = []
    for one in filter(_is_message, vars(results).values()):
        if fields := _fields(one):
            parts += [f"### `{one.topic.name}`", fields]
    return "\n\n".join(parts)


def _is_message(one: object) -> bool:
    return isinstance(one, type) and issubclass(one, Message) and "topic" in vars(one)


def _fields(message: type[msgspec.Struct]) -> str:
    rows = [row for row in _rows(message, "") if row.split("`")[1] not in Message.__struct_fields__]
    return _table(("key", "meaning"), rows) if rows else ""


def _rows(struct: type[msgspec.Struct], path: str) -> Iterator[str]:
    """Yield a row for each field of a message and of the objects that it contains."""
    meanings = {name: text for base in reversed(struct.__mro__) for name, text in _attribute_docstrings(base).items()}
    for field in msgspec.structs.fields(struct):
        nested, levels = _find_struct(field.type, 0)
        names = (f"{path}{field.encode_name}", "<axis>", "<letter>")[: levels + 1]
        if meaning := meanings.get(field.name):
            yield f"| `{path}{field.encode_name}` | {_cell(meaning)} |"
        if nested is not None:
            yield from _rows(nested, ".".join(names) + ".")


def _find_struct(kind: Any, levels: int) -> tuple[type[msgspec.Struct] | None, int]:
    """Return the struct that a type contains, and the number of dictionaries around it."""
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return kind, levels
    inner = (_find_struct(one, levels + (get_origin(kind) is dict)) for one in get_args(kind))
    return next((one for one in inner if one[0] is not None), (None, 0))


def _attribute_docstrings(one: type) -> dict[str, str]:
    """Return the strings that follow the fields in the source of a class."""
    if one.__module__.split(".")[0] != "monitor":
        return {}
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(one))).body
    assert isinstance(body, ast.ClassDef)
    found = {}
    for field, text in zip(body.body, body.body[1:], strict=False):
        match field, text:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(words))):
                found[name] = " ".join(words.replace("``", "`").split())
    return found


def format_python() -> str:
    """List the public names of the Python interface, whose docstrings Sphinx inserts."""
    parts = []
    for name in imu_monitor.__all__:
        value = getattr(imu_monitor, name)
        kind = "module" if inspect.ismodule(value) else "class" if isinstance(value, type) else "function"
        parts.append(f".. auto{kind}:: imu_monitor.{name}")
        parts += [] if kind == "function" else ["   :members:"]
    return "\n".join(["```{eval-rst}", *parts, "```"])


def format_layouts() -> str:
    """List the layouts of public programs and data sets that the tests read."""
    rows = []
    for layout in LAYOUTS:
        names = " and ".join(f"`{word}`" for word in layout.options.split() if word.startswith("--"))
        result = "refused as such" if layout.refused else f"asks for {names}" if names else "read"
        rows.append(f"| {layout.name} | {_cell(layout.peculiarity)} | {result} | {_cell(layout.source)} |")
    return _table(("layout", "peculiarity", "result", "source"), rows)


PARTS: Final[dict[str, Callable[[], str]]] = {
    "commands": format_commands,
    "configuration": format_configuration,
    "layouts": format_layouts,
    "messages": format_messages,
    "python": format_python,
}


def fill_page(text: str) -> str:
    """Return the text of a page with its generated parts regenerated."""
    return PART.sub(lambda part: f"{part[1]}\n{PARTS[part[2]]()}\n\n{part[3]}", text)


if __name__ == "__main__":
    for page in PAGES:
        old = page.read_text("utf-8")
        if (new := fill_page(old)) != old:
            page.write_text(new, "utf-8")
