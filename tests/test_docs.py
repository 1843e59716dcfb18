"""The pages say what is so: commands, keys, settings, links, names of functions, and the programs printed in them."""

import ast
import re
import selectors
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import IO
from urllib.parse import quote

import numpy as np
import pytest
import typer

import drivers.decoders
from drivers import module_lookup
from drivers.data_types import EVENT_KINDS, make_block
from drivers.recordings import FORMATS
from drivers.zenoh.sample_message import encode_samples
from monitor.cli import app
from monitor.common import topics
from monitor.noise.model import NoiseModel
from monitor.noise.model_loading import read_model
from monitor.publishing.messages.results import CoefficientsMessage
from monitor.publishing.rerun.sinks import server_url
from monitor.publishing.zenoh.publisher import ZenohPublisher
from monitor.settings import loading
from monitor.settings.loading import ZenohTable
from tests.monitor.publishing.made import estimate
from tests.support.ports import free_endpoint
from tests.support.waiting import wait_for

ROOT = Path(__file__).resolve().parent.parent
README = ROOT / "README.md"
ARCHITECTURE = ROOT / "docs" / "architecture.md"
NOT_DRAWN = {"extras", "file_access", "module_lookup", "number_ranges", "settings_model"}
"""Small modules without a box of their own in the diagram."""
SIMULATOR = ROOT / "docs" / "simulator.md"
COMMANDS_PAGE = ROOT / "docs" / "commands.md"
MESSAGES = ROOT / "docs" / "messages.md"
DECODERS = ROOT / "docs" / "decoders.md"
CONTRIBUTING = ROOT / "CONTRIBUTING.md"
PAGES = sorted([README, ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")])
COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]
PRINTED_BY = "tcp/127.0.0.1:7450"


def options(command: str) -> set[str]:
    """All that a command takes, or its own commands do."""
    each = [COMMANDS[command], *getattr(COMMANDS[command], "commands", {}).values()]
    return {
        option
        for one in each
        for parameter in one.params
        for option in parameter.opts
        if option.startswith("--") and not getattr(parameter, "hidden", False)
    }


def title(page: Path) -> str:
    return str(page.relative_to(ROOT))


def fences(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text("utf-8"), re.M | re.S)


def code(page: Path) -> list[str]:
    """All that is set as code: fenced blocks, and spans between backticks in the rest."""
    text = page.read_text("utf-8")
    fenced = re.findall(r"^```\w*\n(.*?)^```", text, re.M | re.S)
    return fenced + re.findall(r"`([^`]+)`", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S))


def section(page: Path, heading: str) -> str:
    parts = re.split(r"^## ", page.read_text("utf-8"), flags=re.M)
    return next(part for part in parts if part.startswith(heading + "\n"))


def first_cells(text: str) -> list[str]:
    """The code in the first column of the section's tables."""
    return re.findall(r"^\| `([^`]+)` \|", text, re.M)


# --- settings and commands


@pytest.mark.parametrize("toml", [t for page in PAGES for t in fences(page, "toml") if "[[device]]" in t])
def test_every_configuration_is_one(toml: str, tmp_path: Path) -> None:
    (tmp_path / "recording.csv").write_text("t,gz\n0.00,0.1\n0.01,0.2\n")
    (tmp_path / "page.toml").write_text(toml)
    assert loading.examine_config_file(tmp_path / "page.toml").wrong == []


@pytest.mark.parametrize("toml", [t for page in PAGES for t in fences(page, "toml") if "angle_random_walk]" in t])
def test_every_model_is_one_that_can_be_simulated(toml: str) -> None:
    model = NoiseModel.from_toml(toml)
    assert model.sample_rate_hz is not None
    model.start_stream(model.sample_rate_hz, 1).draw_next_samples(10)


def test_the_catalogue_is_that_of_the_folder() -> None:
    rows = re.findall(r"^\| `([^`]+)` \|.*\| ([\d.]+) \|$", section(SIMULATOR, "The catalogue"), re.M)
    models = [(path.stem, read_model(path)) for path in sorted((ROOT / "config" / "models").glob("*.toml"))]
    assert rows == [(name, f"{model.sample_rate_hz:g}") for name, model in models]


def test_the_configurations_show_every_link() -> None:
    shown = {found for toml in fences(README, "toml") for found in re.findall(r'link = "(\w+)"', toml)}
    assert shown == {"serial", "can", "zenoh", "replay"}


@pytest.mark.parametrize("page", PAGES, ids=title)
def test_every_command_is_one(page: Path) -> None:
    for text in code(page):
        for line in text.splitlines():
            for word, rest in re.findall(r"\bimu-monitor ([a-z][\w-]*)(.*)", line):
                assert word in COMMANDS, line
                assert set(re.findall(r"--[a-z-]+", rest)) <= options(word), line


def test_the_table_has_every_command_and_its_options() -> None:
    row = r"^\| `imu-monitor ([\w-]+)[^`]*` \|(.*)"
    rows = re.findall(row, COMMANDS_PAGE.read_text("utf-8"), re.M)
    assert [name for name, _ in rows] == list(COMMANDS)
    assert [name for name, _ in re.findall(row, section(README, "Commands"), re.M)] == list(COMMANDS)
    everywhere = {"--help", "--seconds", "--viewer"}
    for name, row in rows:
        assert options(name) - everywhere == set(re.findall(r"--[a-z-]+", row)), name


def test_the_viewers_address_is_the_one_it_listens_on() -> None:
    own = loading.ViewerTable()
    page = f"http://127.0.0.1:{own.web_port}/?url={quote(server_url(own.port), safe='')}"
    assert f"`{page}`" in README.read_text("utf-8")
    assert f"-L {own.web_port}:127.0.0.1:{own.web_port} -L {own.port}:127.0.0.1:{own.port}" in README.read_text("utf-8")


# --- tables


def test_the_keys_are_those_that_are_published() -> None:
    rows = re.findall(r"^\| `(imu/[^`]+)` \| (\S*) ?\|", MESSAGES.read_text("utf-8"), re.M)
    encodings = {topics.JSON: "JSON", topics.MSGPACK: "msgpack", "": ""}
    published = [(topic.key("imu", "<device>"), encodings[topic.encoding]) for topic in topics.TOPICS]
    assert sorted(rows) == sorted(published)


def test_the_kinds_of_events_are_those_that_a_hook_may_wait_for() -> None:
    (row,) = re.findall(r"^\| `imu/<device>/event` \|.*$", MESSAGES.read_text("utf-8"), re.M)
    assert sorted(re.findall(r"`(\w+)`", row)) == sorted(EVENT_KINDS)
    made = re.compile(
        r'(?:Event\(|Told\([\w.]+, |_event\(|announce\([\w.]+, |^(?:KIND|CROSSED|BACK): Final = )"([a-z]+_[a-z_]+)"',
        re.M,
    )
    sources = [*ROOT.glob("drivers/**/*.py"), *ROOT.glob("monitor/**/*.py")]
    said = {
        kind for path in sources if "Event" in path.read_text("utf-8") for kind in made.findall(path.read_text("utf-8"))
    }
    assert len(said) > 5
    assert said <= set(EVENT_KINDS)


def test_the_protocols_are_those_that_are_decoded() -> None:
    assert sorted(first_cells(DECODERS.read_text("utf-8"))) == sorted(module_lookup.list_modules(drivers.decoders))


def test_every_kind_of_recording_is_named() -> None:
    named = re.findall(r"\.[a-z0-9.]+", next(t for t in fences(README, "toml") if "recording.csv" in t))
    assert set(FORMATS) <= set(named)


# --- links, pictures, files, names


@pytest.mark.parametrize("page", PAGES, ids=title)
def test_every_link_leads_somewhere(page: Path) -> None:
    text = re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.M | re.S)
    for alt, target in re.findall(r"!?\[([^\]]+)\]\(([^)]+)\)", text):
        assert alt
        if not re.match(r"https?://", target):
            assert (page.parent / target.partition("#")[0]).exists(), target
    assert "![](" not in text, "a picture without words for those who cannot see it"


@pytest.mark.parametrize("page", PAGES, ids=title)
def test_every_file_named_is_there(page: Path) -> None:
    for text in code(page):
        for path in re.findall(r"(?<![\w/-])((?:monitor|drivers|config|tests|docs)/[\w./-]*\w)", text):
            assert (ROOT / path).exists(), path


def test_the_layers_drawn_are_those_of_the_contracts_in_their_order() -> None:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]["contracts"]
    drawn = section(ARCHITECTURE, "Layers")
    for contract in (one for one in contracts if one["type"] == "layers"):
        places = []
        for layer in contract["layers"]:
            names = [name.rpartition(".")[2] for name in layer.split(" | ")]
            found = [match.start() for name in names for match in re.finditer(rf"\b{name}\[", drawn)]
            assert found or set(names) <= NOT_DRAWN, layer
            places += found[:1]
        assert places == sorted(places)


def defined() -> set[str]:
    """What the sources define: ``module``, ``name``, ``Class.method``, ``module.function``."""
    names: set[str] = set()
    for path in [*ROOT.glob("drivers/**/*.py"), *ROOT.glob("monitor/**/*.py")]:
        names.add(path.stem)
        for node in ast.parse(path.read_text("utf-8")).body:
            if not isinstance(node, ast.FunctionDef | ast.ClassDef):
                continue
            names |= {node.name, f"{path.stem}.{node.name}"}
            if isinstance(node, ast.ClassDef):
                names |= {f"{node.name}.{item.name}" for item in node.body if isinstance(item, ast.FunctionDef)}
    return names


@pytest.mark.long
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
    said = re.findall(r"`([A-Z]\w+\.\w+|[a-z]\w+\.[a-z]\w+|[A-Z][a-z]\w+|[a-z_]+)`", section(page, heading))
    assert len(said) >= 3
    assert set(said) <= defined()


# --- programs


def first_line(stdout: IO[str], publish: "list[tuple[topics.Topic, bytes]]", zenoh: ZenohPublisher) -> str:
    """What a program prints first, while results are published ten times a second."""
    with selectors.DefaultSelector() as selector:
        selector.register(stdout, selectors.EVENT_READ)

        def printed() -> str:
            for topic, payload in publish:
                zenoh.put(topic, "bench-1", payload)
            return stdout.readline() if selector.select(0.1) else ""

        return wait_for(printed, "a line of the program")


@pytest.mark.parametrize(
    ("page", "word"),
    [(README, "estimated"), (ROOT / "docs" / "samples-format.md", "9.81")],
    ids=["coefficients", "samples"],
)
def test_a_subscriber_as_printed_prints_what_is_published(page: Path, word: str) -> None:
    endpoint = free_endpoint()
    [program] = [text for text in fences(page, "python") if "declare_subscriber" in text]
    assert PRINTED_BY in program
    rows = make_block(np.arange(2) * 10_000_000, np.tile([0.1, 0.2, 0.3, 0.0, 0.0, 9.81], (2, 1)))
    results = [
        (topics.COEFFICIENTS, CoefficientsMessage.from_result("bench-1", 1.76e9, 0, estimate()).encode()),
        (topics.SAMPLES, encode_samples("bench-1", 2, rows)),
    ]
    zenoh = ZenohPublisher(ZenohTable(listen=(endpoint,)), ["bench-1"])
    zenoh.start()
    try:
        wait_for(lambda: zenoh.state == "ok")
        command = [sys.executable, "-u", "-c", program.replace(PRINTED_BY, endpoint)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            try:
                assert process.stdout is not None
                line = first_line(process.stdout, results, zenoh)
            finally:
                process.kill()
    finally:
        zenoh.close()
    assert line.startswith("bench-1 ")
    assert word in line
