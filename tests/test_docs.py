"""Tests that the documentation agrees with the program: commands, keys, settings, links, names and example programs."""

import re
import selectors
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path
from typing import IO
from urllib.parse import quote

import numpy as np
import pytest
import typer

import drivers.decoders
from drivers.data_types import EVENT_KINDS, make_block
from drivers.recordings import FORMATS
from drivers.validation import module_lookup
from drivers.zenoh.sample_message import encode_samples
from monitor.cli import app
from monitor.common import topics
from monitor.noise.model import NoiseModel
from monitor.noise.model_loading import read_model
from monitor.publishing.exporters import FORMATS as EXPORT_FORMATS
from monitor.publishing.exporters.estimator_parameters import PARAMETER_FILES
from monitor.publishing.messages.results import CoefficientsMessage
from monitor.publishing.rerun.sinks import server_url
from monitor.publishing.zenoh.publisher import ZenohPublisher
from monitor.settings import loading
from monitor.settings.loading import ZenohTable
from tests.experiments import picture_sources, reference_pages
from tests.monitor.publishing.example_results import make_estimate
from tests.support.ports import free_endpoint
from tests.support.waiting import wait_for

ROOT = Path(__file__).resolve().parent.parent
README = ROOT / "README.md"
ARCHITECTURE = ROOT / "docs" / "explanation" / "architecture.md"
SIMULATOR = ROOT / "docs" / "how-to" / "simulator.md"
EXPORT = ROOT / "docs" / "reference" / "export.md"
MESSAGES = ROOT / "docs" / "reference" / "messages.md"
DECODERS = ROOT / "docs" / "reference" / "decoders.md"
CONNECTING_SENSORS = ROOT / "docs" / "how-to" / "connecting-sensors.md"
VIEWER = ROOT / "docs" / "how-to" / "viewer.md"
CONTRIBUTING = ROOT / "CONTRIBUTING.md"
PAGES = sorted(
    [
        README,
        ROOT / "CHANGELOG.md",
        ROOT / "CONTRIBUTING.md",
        *(ROOT / "docs").rglob("*.md"),
        *(ROOT / "docs").rglob("*.ipynb"),
    ]
)
COMMANDS = {
    name: command
    for name, command in typer.main.get_command(app).commands.items()  # type: ignore[attr-defined]
    if not command.hidden
}
ENDPOINT_IN_PAGES = "tcp/127.0.0.1:7450"


def list_options(command: str) -> set[str]:
    """Return the visible options of a command and of its subcommands."""
    commands = [COMMANDS[command], *getattr(COMMANDS[command], "commands", {}).values()]
    return {
        option
        for item in commands
        for parameter in item.params
        for option in parameter.opts
        if option.startswith("--") and not getattr(parameter, "hidden", False)
    }


def get_title(page: Path) -> str:
    return str(page.relative_to(ROOT))


def find_code_blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text("utf-8"), re.M | re.S)


def find_code(page: Path) -> list[str]:
    """Return all code of a page: the fenced blocks, and the spans between backticks in the other text."""
    text = page.read_text("utf-8")
    fenced = re.findall(r"^```\w*\n(.*?)^```", text, re.M | re.S)
    return fenced + re.findall(r"`([^`]+)`", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S))


def get_section(page: Path, heading: str) -> str:
    parts = re.split(r"^## ", page.read_text("utf-8"), flags=re.M)
    return next(part for part in parts if part.startswith(heading + "\n"))


def find_first_cells(text: str) -> list[str]:
    """Return the code in the first column of the tables in a text."""
    return re.findall(r"^\| `([^`]+)` \|", text, re.M)


# --- settings and commands


@pytest.mark.parametrize("toml", [t for page in PAGES for t in find_code_blocks(page, "toml") if "[[device]]" in t])
def test_every_configuration_is_valid(toml: str, tmp_path: Path) -> None:
    (tmp_path / "recording.csv").write_text("t,gz\n0.00,0.1\n0.01,0.2\n")
    (tmp_path / "page.toml").write_text(toml)
    assert loading.examine_config_file(tmp_path / "page.toml").wrong == []


@pytest.mark.parametrize(
    "toml", [t for page in PAGES for t in find_code_blocks(page, "toml") if "angle_random_walk]" in t]
)
def test_every_noise_model_can_be_simulated(toml: str) -> None:
    model = NoiseModel.from_toml(toml)
    assert model.sample_rate_hz is not None
    model.start_stream(model.sample_rate_hz, 1).draw_next_samples(10)


def test_the_tables_of_exports_list_every_format_and_parameter() -> None:
    rows = dict(re.findall(r"^\| `(\w+)` \|(.*)$", get_section(EXPORT, "Formats"), re.M))
    assert rows.keys() == EXPORT_FORMATS.keys()
    assert set(re.findall(r"^\| `(\w+)` \|", get_section(EXPORT, "Sources and checks"), re.M)) == set(EXPORT_FORMATS)
    for file in PARAMETER_FILES:
        names = set(re.findall(r"`([\w.]+)`", rows[file.name]))
        written = {parameter.name for parameter in file.parameters}
        assert written <= names or "kalibr" in names
        for letter in {parameter.letter for parameter in file.parameters}:
            formula = file.form.formula(letter).replace("^2", "²").replace("sqrt(dt)", "√dt")
            assert formula in rows[file.name].split("|")[3]


def test_catalogue_lists_the_model_files() -> None:
    rows = re.findall(r"^\| `([^`]+)` \|.*\| ([\d.]+) \|$", get_section(SIMULATOR, "The catalogue"), re.M)
    models = [(path.stem, read_model(path)) for path in sorted((ROOT / "config" / "models").glob("*.toml"))]
    assert rows == [(name, f"{model.sample_rate_hz:g}") for name, model in models]


def test_configurations_show_every_link() -> None:
    shown = {
        found for toml in find_code_blocks(CONNECTING_SENSORS, "toml") for found in re.findall(r'link = "(\w+)"', toml)
    }
    assert shown == {"serial", "can", "iio", "zenoh", "replay"}


@pytest.mark.parametrize("page", PAGES, ids=get_title)
def test_every_command_and_option_exists(page: Path) -> None:
    for text in find_code(page):
        for line in text.splitlines():
            for word, rest in re.findall(r"\bimu-monitor ([a-z][\w-]*)(.*)", line):
                assert word in COMMANDS, line
                assert set(re.findall(r"--[a-z-]+", rest)) <= list_options(word), line


def test_readme_lists_every_command() -> None:
    rows = re.findall(r"^\| `imu-monitor ([\w-]+)[^`]*` \|", get_section(README, "Commands"), re.M)
    assert rows == list(COMMANDS)


@pytest.mark.parametrize("page", reference_pages.PAGES, ids=get_title)
def test_generated_parts_are_current(page: Path) -> None:
    text = page.read_text("utf-8")
    assert reference_pages.fill_page(text) == text, "run: python -m tests.experiments.reference_pages"


def test_every_generated_part_has_a_page() -> None:
    names = [
        part[2] for page in reference_pages.PAGES for part in reference_pages.PART.finditer(page.read_text("utf-8"))
    ]
    assert sorted(names) == sorted(reference_pages.PARTS)


@pytest.mark.parametrize("picture", picture_sources.SOURCES)
def test_picture_shows_the_present_layout(picture: str) -> None:
    pytest.importorskip("rerun")
    pytest.importorskip("matplotlib")
    stored = picture_sources.read_checksums()[picture]
    assert stored == picture_sources.checksum(picture), "run: python -m tests.experiments.pictures"


def test_every_picture_is_shown_by_a_page() -> None:
    shown = {Path(name).name for page in PAGES for name in re.findall(r"pictures/[\w.-]+", page.read_text("utf-8"))}
    assert {path.name for path in picture_sources.PICTURES.glob("*.png")} <= shown


def test_viewer_address_has_the_default_ports() -> None:
    own = loading.ViewerTable()
    page = f"http://127.0.0.1:{own.web_port}/?url={quote(server_url(own.port), safe='')}"
    assert f"`{page}`" in VIEWER.read_text("utf-8")
    assert f"-L {own.web_port}:127.0.0.1:{own.web_port} -L {own.port}:127.0.0.1:{own.port}" in VIEWER.read_text("utf-8")


# --- tables


def test_zenoh_keys_are_those_that_are_published() -> None:
    rows = re.findall(r"^\| `(imu/[^`]+)` \| (\S*) ?\|", MESSAGES.read_text("utf-8"), re.M)
    encodings = {topics.JSON: "JSON", topics.MSGPACK: "msgpack", "": ""}
    published = [(topic.key("imu", "<device>"), encodings[topic.encoding]) for topic in topics.TOPICS]
    assert sorted(rows) == sorted(published)


def test_event_kinds_in_pages_and_sources_are_those_that_hooks_accept() -> None:
    (row,) = re.findall(r"^\| `imu/<device>/event` \|.*$", MESSAGES.read_text("utf-8"), re.M)
    assert sorted(re.findall(r"`(\w+)`", row)) == sorted(EVENT_KINDS)
    event_pattern = re.compile(
        r'(?:Event\(|Told\([\w.]+, |_event\(|announce\([\w.]+, |^(?:KIND|CROSSED|BACK): Final = )"([a-z]+_[a-z_]+)"',
        re.M,
    )
    sources = [*ROOT.glob("drivers/**/*.py"), *ROOT.glob("monitor/**/*.py")]
    texts = [text for path in sources if "Event" in (text := path.read_text("utf-8"))]
    kinds = {kind for text in texts for kind in event_pattern.findall(text)}
    assert len(kinds) > 5
    assert kinds <= set(EVENT_KINDS)


def test_protocol_table_lists_every_decoder() -> None:
    assert sorted(find_first_cells(DECODERS.read_text("utf-8"))) == sorted(module_lookup.list_modules(drivers.decoders))


def test_every_recording_format_is_named() -> None:
    named = re.findall(
        r"\.[a-z0-9.]+", next(t for t in find_code_blocks(CONNECTING_SENSORS, "toml") if "recording.csv" in t)
    )
    assert set(FORMATS) <= set(named)


# --- links, pictures, files, names


@pytest.mark.parametrize("page", PAGES, ids=get_title)
def test_every_hyperlink_target_exists(page: Path) -> None:
    text = re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.M | re.S)
    for alt, target in re.findall(r"!?\[([^\]]+)\]\(([^)]+)\)", text):
        assert alt
        if not re.match(r"https?://", target):
            assert (page.parent / target.partition("#")[0]).exists(), target
    assert "![](" not in text, "an image without alternative text"


def expand_braces(text: str) -> list[str]:
    """Return the alternatives of ``a/{b,c}/d``."""
    found = re.search(r"\{([^{}]*)\}", text)
    if found is None:
        return [text]
    return [
        one for part in found[1].split(",") for one in expand_braces(text[: found.start()] + part + text[found.end() :])
    ]


def find_paths(text: str) -> list[str]:
    """Return the paths in this project that a text names, up to the first placeholder such as ``<name>``."""
    found = re.findall(r"(?<![\w/-])((?:monitor|drivers|config|tests|docs|imu_monitor)/[\w./{},-]*[\w/}])", text)
    return [path for item in found for path in expand_braces(item)]


def test_every_named_file_exists() -> None:
    wrong = {
        f"{get_title(page)}: {path} does not exist"
        for page in PAGES
        for text in find_code(page)
        for path in find_paths(text)
        if not (ROOT / path).exists()
    }
    assert not wrong, "\n".join(sorted(wrong))


PARTS = {
    "a link": "drivers/links/serial_link.py",
    "a decoder": "drivers/decoders/binary_frames/stim300.py",
    "an effect": "monitor/noise/effects/ieee952/rate_ramp.py",
    "a figure": "monitor/publishing/plots/allan_figure.py",
    "a command": "monitor/cli/analyze.py",
    "an output of the service": "monitor/daemon/outputs/zenoh_output.py",
    "an export": "monitor/publishing/exporters/kalman.py",
    "a format of recordings": "drivers/recordings/file_formats/csv_format.py",
}
"""An existing part of each kind of the table "Adding a part"."""


@pytest.mark.parametrize(("kind", "part"), PARTS.items())
def test_a_part_is_where_the_table_says_and_the_named_files_refer_to_it(kind: str, part: str) -> None:
    (row,) = re.findall(rf"^\| {kind} \| (.*) \|$", CONTRIBUTING.read_text("utf-8"), re.M)
    named = [path for text in re.findall(r"`([^`]+)`", row) for path in find_paths(text)]
    folders = {path.rstrip("/") if (ROOT / path).is_dir() else str(Path(path).parent) for path in named}
    assert str(Path(part).parent) in folders, f"{kind}: {part} is in none of {sorted(folders)}"
    own = (ROOT / part).read_text("utf-8")
    for path in (path for path in named if path.endswith(".py") and (ROOT / path).is_file()):
        text = (ROOT / path).read_text("utf-8")
        assert any(
            re.search(rf"\b{name}\b", to)
            for source, stem, to in ((own, Path(part).stem, text), (text, Path(path).stem, own))
            for name in {stem, *re.findall(r"^(?:def|class) (\w+)", source, re.M)}
        ), f"{kind}: {path} has nothing to do with {part}"


def test_diagram_shows_the_layers_of_the_import_contracts_in_order() -> None:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]["contracts"]
    drawn = get_section(ARCHITECTURE, "Layers")
    for contract in (item for item in contracts if item["type"] == "layers"):
        positions = []
        for layer in contract["layers"]:
            names = [name.rpartition(".")[2] for name in layer.split(" | ")]
            found = [match.start() for name in names for match in re.finditer(rf"\b{name}\[", drawn)]
            assert found, layer
            positions += found[:1]
        assert positions == sorted(positions)


PACKAGES = ("drivers", "monitor", "imu_monitor", "tests")
SOURCES = [path for package in PACKAGES for path in ROOT.glob(f"{package}/**/*.py")]
FOREIGN_NAMES = {
    "PreintegrationCombinedParams", "PreintegrationParams", "RandomWalk",
    "NoiseDensity", "SampleUS", "TimeMS", "TimeUS", "ValueError", "WatchdogSec",
}  # fmt: skip
"""CamelCase names in pages that belong to other programs, formats and packages."""
DEFINITION = re.compile(
    r"^( *)(?:(?:async )?def|class) (\w+)|^( {4})?(\w+)(?:: [^=\n]+)?(?: =|$)|^ {8}self\.(\w+)(?:: [^=\n]+)? =", re.M
)


@cache
def list_defined_names() -> frozenset[str]:
    """Return all names that the sources define: ``module``, ``name``, ``Class.member``, ``module.function``."""
    names: set[str] = set()
    for path in SOURCES:
        module = owner = path.parent.name if path.stem == "__init__" else path.stem
        names.add(module)
        for indent, name, member_indent, value, attribute in DEFINITION.findall(path.read_text("utf-8")):
            found = name or value or attribute
            if name and not indent:
                owner = found
            names.add(f"{owner}.{found}")
            if not (indent or member_indent or attribute):
                names |= {found, f"{module}.{found}"}
    return frozenset(names)


def is_defined(name: str) -> bool:
    """Return True if a module, class, function or member has this name, which may be dotted."""
    parts = name.split(".")
    path = ROOT.joinpath(*parts)
    if path.is_dir() or path.with_suffix(".py").is_file():
        return True
    if len(parts) == 2 and parts[0] != "imu_monitor" and parts[0] in PACKAGES:
        return False  # such as a deleted module
    return ".".join(parts[-2:]) in list_defined_names() or (parts[0] in PACKAGES and parts[-1] in list_defined_names())


@pytest.mark.parametrize(
    "page", [page for page in PAGES if page.suffix == ".md" and page.name != "CHANGELOG.md"], ids=get_title
)
def test_every_name_of_a_module_class_or_member_is_defined(page: Path) -> None:
    text = re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.M | re.S)
    wrong = []
    for code in re.findall(r"`([^`\n]+)`", text):
        name = re.sub(r"\(.*", "", code)
        module = re.fullmatch(r"(?:drivers|monitor|imu_monitor|tests)(?:\.\w+)+", name)
        member = re.fullmatch(r"([A-Z][a-z]\w*)\.[a-z_]\w*", name)
        if not (module or re.fullmatch(r"(?:[A-Z][a-z0-9]+){2,}", name) or (member and is_defined(member[1]))):
            continue
        if name not in FOREIGN_NAMES and not is_defined(name):
            wrong.append(f"{get_title(page)}: `{code}` is not defined")
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    ("page", "heading"),
    [
        (CONTRIBUTING, "One sample through the code"),
        (ARCHITECTURE, "Data flow"),
        (ARCHITECTURE, "Threads"),
    ],
    ids=["contributing", "data flow", "threads"],
)
def test_every_name_in_the_text_is_defined(page: Path, heading: str) -> None:
    mentioned = re.findall(r"`([A-Z]\w+\.\w+|[a-z]\w+\.[a-z]\w+|[A-Z][a-z]\w+|[a-z_]+)`", get_section(page, heading))
    assert len(mentioned) >= 3
    assert sorted(set(mentioned) - list_defined_names()) == []


# --- programs


def read_first_line(stdout: IO[str], publish: "list[tuple[topics.ZenohTopic, bytes]]", zenoh: ZenohPublisher) -> str:
    """Return the first line that a program prints, while results are published ten times a second."""
    with selectors.DefaultSelector() as selector:
        selector.register(stdout, selectors.EVENT_READ)

        def publish_and_read() -> str:
            for topic, payload in publish:
                zenoh.put(topic, "bench-1", payload)
            return stdout.readline() if selector.select(0.1) else ""

        return wait_for(publish_and_read, "a line of the program")


@pytest.mark.parametrize(
    ("page", "word"),
    [(MESSAGES, "estimated"), (ROOT / "docs" / "reference" / "samples-format.md", "9.81")],
    ids=["coefficients", "samples"],
)
def test_subscriber_example_prints_the_published_results(page: Path, word: str) -> None:
    endpoint = free_endpoint()
    [program] = [text for text in find_code_blocks(page, "python") if "declare_subscriber" in text]
    assert ENDPOINT_IN_PAGES in program
    rows = make_block(np.arange(2) * 10_000_000, np.tile([0.1, 0.2, 0.3, 0.0, 0.0, 9.81], (2, 1)))
    results = [
        (topics.COEFFICIENTS, CoefficientsMessage.from_result("bench-1", 1.76e9, 0, make_estimate()).encode()),
        (topics.SAMPLES, encode_samples("bench-1", 2, rows)),
    ]
    zenoh = ZenohPublisher(ZenohTable(listen=(endpoint,)), ["bench-1"])
    zenoh.start()
    try:
        wait_for(lambda: zenoh.state == "ok")
        command = [sys.executable, "-u", "-c", program.replace(ENDPOINT_IN_PAGES, endpoint)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            try:
                assert process.stdout is not None
                line = read_first_line(process.stdout, results, zenoh)
            finally:
                process.kill()
    finally:
        zenoh.close()
    assert line.startswith("bench-1 ")
    assert word in line
