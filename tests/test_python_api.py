"""Tests of the Python interface: its public names and signatures, the examples of its page, and foreign packages."""

import contextlib
import inspect
import io
import json
import os
import pickle
import re
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import imu_monitor
from drivers.errors import make_printable_and_shorten
from monitor.cli import main
from monitor.commands import analyze as analyze_command
from monitor.noise.effects import EFFECTS
from tests.experiments.attacks.test_environments import create_foreign_packages

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "reference" / "python-api.md"
RATE_HZ = 100.0
NOISE_MODEL_METHODS = {"avar", "from_toml", "to_dict", "to_toml", "two_sided_psd"}
"""Public methods of ``NoiseModel``. Its other methods serve the commands."""


@pytest.fixture(scope="module")
def recording() -> imu_monitor.Recording:
    return imu_monitor.simulate("mti-1", duration_s=300.0)


@pytest.fixture(scope="module")
def analysis(recording: imu_monitor.Recording) -> imu_monitor.Analysis:
    return imu_monitor.analyze(recording, total_and_hadamard=True)


# --- contract


def format_signature(name: str, function: Any) -> str:
    """Return the name and the arguments of a function, without annotations."""
    signature = inspect.signature(function)
    bare = [one.replace(annotation=inspect.Parameter.empty) for one in signature.parameters.values()]
    kept = [one for one in bare if one.name != "self"]
    bare_signature = signature.replace(parameters=kept, return_annotation=inspect.Signature.empty)
    return f"{name}{bare_signature}".replace("<factory>", "{}")


def list_members(kind: type) -> list[str]:
    """Return the public attributes and methods of a class, without those of mappings."""
    declared = [field.name for field in fields(kind)] if is_dataclass(kind) else []
    members = []
    for name in dir(kind):
        if name.startswith("_") or name in declared or hasattr(Mapping, name):
            continue
        if kind is imu_monitor.NoiseModel and name not in NOISE_MODEL_METHODS:
            continue
        member = inspect.getattr_static(kind, name)
        is_method = inspect.isfunction(member) or isinstance(member, classmethod)
        members.append(format_signature(name, getattr(kind, name)) if is_method else name)
    return declared + members


def describe_interface() -> str:
    """Return the tables of public names for the page of the Python interface."""
    functions = ["| function | result |", "| --- | --- |"]
    classes = ["| class | attributes and methods |", "| --- | --- |"]
    for name in imu_monitor.__all__:
        public = getattr(imu_monitor, name)
        if inspect.isfunction(public):
            result = inspect.formatannotation(inspect.signature(public).return_annotation)
            functions.append(f"| `{format_signature(name, public)}` | `{result.strip(chr(39)).rpartition('.')[2]}` |")
        elif inspect.isclass(public) and not issubclass(public, Exception):
            shown = name
            if name in ("AllanWindow", "NoiseModel"):
                shown = format_signature(name, public)
            classes.append(f"| `{shown}` | {', '.join(f'`{member}`' for member in list_members(public))} |")
    return "\n".join([*functions, "", *classes])


def test_page_lists_exactly_the_public_names_and_signatures() -> None:
    assert describe_interface() in PAGE.read_text("utf-8")


def test_errors_and_modules_are_named_on_the_page() -> None:
    others = [
        name
        for name in imu_monitor.__all__
        if inspect.ismodule(getattr(imu_monitor, name)) or f"`{name}" not in describe_interface()
    ]
    assert sorted(others) == ["ConfigError", "ImuError", "NotReady", "RecordingError", "effects"]
    assert all(name in PAGE.read_text("utf-8") for name in others)


def test_lazy_names_are_all_public_names() -> None:
    lazy = {name for names in imu_monitor._MODULES.values() for name in names}
    assert sorted(lazy | {"effects"}) == imu_monitor.__all__
    assert set(imu_monitor.__all__) <= set(dir(imu_monitor))
    with pytest.raises(AttributeError, match="no attribute 'analyse'"):
        imu_monitor.analyse  # noqa: B018


def test_effects_are_those_of_model_files() -> None:
    for effect in EFFECTS.values():
        assert getattr(imu_monitor.effects, effect.__name__) is effect


@pytest.mark.parametrize("name", [name for name in imu_monitor.__all__ if name != "effects"])
def test_docstrings_describe_arguments_errors_and_examples(name: str) -> None:
    public = getattr(imu_monitor, name)
    text = inspect.getdoc(public) or ""
    assert text
    if inspect.isfunction(public):
        for argument in inspect.signature(public).parameters:
            assert re.search(rf"^{argument} : ", text, re.M), argument
        assert "Examples\n---" in text
        assert "Raises\n---" in text or name == "list_models"


# --- examples


def run_examples(page: Path, word: str) -> int:
    """Run the Python examples of a page that contain a word, and compare their output with the text that follows."""
    blocks = re.findall(r"^```python\n(.*?)^```\n(?:\n```text\n(.*?)^```)?", page.read_text("utf-8"), re.M | re.S)
    names: dict[str, Any] = {}
    count = 0
    for code, expected in blocks:
        if word in code or names:
            output = io.StringIO()
            with contextlib.redirect_stdout(output):
                exec(compile(code, str(page), "exec"), names)
            assert output.getvalue() == expected, code
            count += 1
    return count


def test_examples_of_the_page_print_the_shown_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert run_examples(PAGE, "imu_monitor") == PAGE.read_text("utf-8").count("```python\n")
    names = {"allan.png", "report.html", "run.csv", "reconciled"}
    assert {path.name for path in tmp_path.iterdir()} == names


def test_example_of_the_readme_prints_the_shown_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "README.md").read_text("utf-8")
    page = tmp_path / "README.md"
    page.write_text(text.split("\n## Use it in Python\n")[1].split("\n## ")[0])
    assert run_examples(page, "imu_monitor") == 1


# --- same results as the commands


def test_results_are_those_of_the_commands(
    recording: imu_monitor.Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    def run_command(*arguments: str) -> None:
        monkeypatch.setattr(sys, "argv", ["imu-monitor", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code in (0, None)

    run_command("simulate", "mti-1", "--seconds", "300", "--out", "run.npz")
    read = imu_monitor.read_recording("run.npz")
    np.testing.assert_array_equal(read.values, recording.values)
    run_command("analyze", "run.npz", "--json", "result.json")
    result = imu_monitor.analyze(read, total_and_hadamard=True)
    assert result.to_dict() == json.loads((tmp_path / "result.json").read_bytes())
    run_command("export", "result.json", "--format", "kalman", "--out", "kalman.txt")
    written = (tmp_path / "kalman.txt").read_text().splitlines()
    exported = imu_monitor.export_parameters(result, "kalman").splitlines()
    with pytest.raises(imu_monitor.ConfigError, match="in another source too"):
        imu_monitor.export_parameters([result, result], "kalman")
    assert [line for line in exported if "source" not in line] == [line for line in written if "source" not in line]
    run_command("reconcile", "run.npz", "--model", "mti-1", "--out", "report")
    assert imu_monitor.reconcile(read, "mti-1").to_dict() == json.loads((tmp_path / "report/report.json").read_bytes())


def test_window_agrees_with_the_analysis_of_the_same_samples(
    recording: imu_monitor.Recording, analysis: imu_monitor.Analysis
) -> None:
    window = imu_monitor.AllanWindow(RATE_HZ, 300.0)
    for block in np.array_split(recording.values, 7):
        window.append(block)
    estimate = window.estimate()
    assert list(estimate) == list(analysis)
    for axis, one in estimate.items():
        np.testing.assert_allclose(one.allan.deviation, analysis[axis].allan.deviation, rtol=1e-9)
        assert one.coefficients["N"].value == pytest.approx(analysis[axis].coefficients["N"].value, rel=1e-3)
    assert estimate.to_dict()["axes"].keys() == analysis.to_dict()["axes"].keys()
    assert "N" in imu_monitor.export_parameters(estimate, "kalman")


def test_window_keeps_the_place_of_missing_samples(recording: imu_monitor.Recording) -> None:
    values = np.array(recording["gz"][:2000])
    with_gap = imu_monitor.AllanWindow(RATE_HZ, 60.0, axes="gz")
    with_gap.append(values[:900])
    with_gap.append(values[1000:], missing_before=100)
    values[900:1000] = np.nan
    with_nan = imu_monitor.AllanWindow(RATE_HZ, 60.0, axes="gz")
    for value in values:
        with_nan.append([value])
    assert len(with_gap) == len(with_nan) == 2000
    one, other = (window.estimate()["gz"].allan for window in (with_gap, with_nan))
    np.testing.assert_array_equal(one.deviation, other.deviation)
    with_gap.clear()
    assert len(with_gap) == 0


# --- forms of samples


def test_all_forms_of_the_same_samples_give_the_same_result(recording: imu_monitor.Recording) -> None:
    pandas = pytest.importorskip("pandas")
    gz = np.array(recording["gz"][:6000])
    columns = {"t": np.arange(6000) / RATE_HZ, "gz": gz, "comment": ["x"] * 6000}
    forms: list[tuple[Any, dict[str, Any]]] = [
        (gz, {"rate_hz": RATE_HZ, "axes": "gz"}),
        (gz[:, None], {"rate_hz": RATE_HZ, "axes": ["gz"]}),
        (gz.tolist(), {"rate_hz": RATE_HZ, "axes": "gz"}),
        ({"gz": gz}, {"rate_hz": RATE_HZ}),
        (columns, {}),
        (pandas.DataFrame(columns), {}),
        (imu_monitor.simulate("mti-1", duration_s=300.0).to_dataframe()[["t", "gz"]][:6000], {}),
    ]
    results = [imu_monitor.analyze(values, **options).to_dict() for values, options in forms]
    assert list(results[0]["axes"]) == ["gz"]
    assert all(result == results[0] for result in results)
    assert gz.flags.writeable


ERRORS: dict[str, tuple[Any, type[Exception], str]] = {
    "no rate": (lambda r: imu_monitor.analyze(r.values), imu_monitor.ConfigError, "rate_hz: is needed"),
    "absurd rate": (
        lambda r: imu_monitor.analyze(r.values, -1.0),
        imu_monitor.ConfigError,
        "rate_hz: -1 Hz is outside",
    ),
    "transposed": (
        lambda r: imu_monitor.analyze(r.values.T, 100.0),
        imu_monitor.ConfigError,
        "values: shape (6, 30000), expected (n, 6)",
    ),
    "path": (lambda _: imu_monitor.analyze("run.csv"), imu_monitor.ConfigError, "read the file with read_recording"),
    "text": (
        lambda _: imu_monitor.analyze([["a"]], 1.0),
        imu_monitor.ConfigError,
        "values: is not an array of numbers",
    ),
    "axis": (
        lambda r: imu_monitor.analyze(r["gz"], 1.0, axes="rz"),
        imu_monitor.ConfigError,
        'axes: unknown axis "rz"',
    ),
    "axis twice": (
        lambda r: imu_monitor.analyze(r.values[:, :2], 1.0, axes=("gx", "gx")),
        imu_monitor.ConfigError,
        "axes: gx gx; each axis can be given once",
    ),
    "no axis": (lambda _: imu_monitor.analyze({"x": [1.0]}, 1.0), imu_monitor.ConfigError, "no column is an axis"),
    "unequal columns": (
        lambda _: imu_monitor.analyze({"gx": [1.0], "gy": [1.0, 2.0]}, 1.0),
        imu_monitor.RecordingError,
        "values: gy has 2 values but gx has 1",
    ),
    "too few": (lambda r: imu_monitor.analyze(r.values[:10], 1.0), imu_monitor.NotReady, "10 samples; at least 50"),
    "tau": (lambda r: imu_monitor.analyze(r, tau="x"), imu_monitor.ConfigError, 'tau: "x"; possible are octave'),
    "tau range": (lambda r: imu_monitor.analyze(r, tau=[-1.0]), imu_monitor.ConfigError, "tau: -1 s is outside"),
    "window": (lambda r: imu_monitor.analyze(r, window_s=-1.0), imu_monitor.ConfigError, "window_s: -1 s is outside"),
    "missing file": (lambda _: imu_monitor.read_recording("none.csv"), imu_monitor.RecordingError, "none.csv: cannot"),
    "unknown suffix": (lambda r: r.save("x.xyz"), imu_monitor.ConfigError, "x.xyz: "),
    "model": (lambda _: imu_monitor.load_model("mti"), imu_monitor.ConfigError, 'no model "mti"'),
    "model without rate": (
        lambda _: imu_monitor.simulate(imu_monitor.NoiseModel({"gz": ()}), 1.0),
        imu_monitor.ConfigError,
        "the model has no sample_rate; set the rate with rate_hz",
    ),
    "memory": (lambda _: imu_monitor.simulate("mti-1", 9e7), imu_monitor.ConfigError, "duration_s: 9000000000 samples"),
    "seed": (lambda _: imu_monitor.simulate("mti-1", 1.0, seed=-1), imu_monitor.ConfigError, "seed: -1 is outside"),
    "temperature": (
        lambda _: imu_monitor.simulate("mti-1", 1.0, temperature_c=[np.nan]),
        imu_monitor.ConfigError,
        "temperature_c: shape (1,); expected are finite values",
    ),
    "format": (lambda _: imu_monitor.export_parameters("mti-1", "x"), imu_monitor.ConfigError, 'unknown format "x"'),
    "option of another format": (
        lambda _: imu_monitor.export_parameters("mti-1", "kalibr", dt_s=1.0),
        imu_monitor.ConfigError,
        "dt_s: is an option of vins_fusion",
    ),
    "long window": (
        lambda _: imu_monitor.AllanWindow(1e5, 1e5),
        imu_monitor.ConfigError,
        "window_s: 100000 s at 100000 Hz",
    ),
    "window rate": (lambda _: imu_monitor.AllanWindow(1e9), imu_monitor.ConfigError, "rate_hz: 1 GHz is outside"),
    "empty window": (lambda _: imu_monitor.AllanWindow(9.0).estimate(), imu_monitor.NotReady, "0 of at least 8"),
    "window shape": (lambda _: imu_monitor.AllanWindow(9.0).append([1, 2]), imu_monitor.ConfigError, "shape (2,)"),
    "reconcile too few": (
        lambda r: imu_monitor.reconcile(r.values[:99], None, 9.0),
        imu_monitor.NotReady,
        "99 samples",
    ),
    "table": (lambda r: imu_monitor.analyze(r).to_dataframe("x"), imu_monitor.ConfigError, 'table: "x"; possible are'),
    "units": (
        lambda r: imu_monitor.plot_allan(imu_monitor.analyze(r), units="x"),
        imu_monitor.ConfigError,
        'units: "x"; possible are imu, datasheet, si',
    ),
}


@pytest.mark.parametrize("case", ERRORS)
def test_errors_name_the_argument_in_one_line(
    case: str, recording: imu_monitor.Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    call, kind, text = ERRORS[case]
    with pytest.raises(kind) as raised:
        call(recording)
    line = str(raised.value)
    assert text in line
    assert line == make_printable_and_shorten(line)
    assert "--" not in line


@pytest.mark.parametrize(("option", "text"), [("pandas", 'pip install "pandas"'), ("matplotlib", "imu-monitor[plot]")])
def test_missing_libraries_are_named(
    option: str, text: str, analysis: imu_monitor.Analysis, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, option, None)
    with pytest.raises(imu_monitor.ConfigError, match=re.escape(text)):
        _ = analysis.to_dataframe() if option == "pandas" else imu_monitor.plot_allan(analysis)
    assert ("<svg" in analysis._repr_html_()) == (option == "pandas")


def test_notes_name_arguments(recording: imu_monitor.Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    found = analyze_command.analyze_recording(recording)
    note = "give it with --rate HZ"
    monkeypatch.setattr("imu_monitor._analysis.analyze_recording", lambda *_: found)
    object.__setattr__(found.analysis, "notes", (note,))
    assert imu_monitor.analyze(recording).notes == ("give it with rate_hz",)


# --- presentation


def test_results_show_themselves_in_a_notebook(
    recording: imu_monitor.Recording, analysis: imu_monitor.Analysis
) -> None:
    html = analysis._repr_html_()
    assert "°/√h" in html
    assert "<svg" in html
    assert len(html) < 200_000
    assert "30000 samples" in recording._repr_html_()
    assert "angle_random_walk" in imu_monitor.load_model("mti-1")._repr_html_()
    assert imu_monitor.plot_allan(analysis)._repr_png_().startswith(b"\x89PNG")


@pytest.mark.parametrize("library", ["matplotlib", None])
def test_reconciliation_shows_the_allan_plot_of_each_axis_that_differs(
    recording: imu_monitor.Recording, library: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = {axis: np.array(recording[axis]) for axis in ("gx", "gz")}
    values["gz"] += 3e-3 * np.sin(2.0 * np.pi * 17.0 / RATE_HZ * np.arange(len(recording)))
    found = imu_monitor.reconcile(values, "mti-1", RATE_HZ)
    if library is not None:
        monkeypatch.setitem(sys.modules, library, None)
    html = found._repr_html_()
    assert "added sinusoidal" in html
    assert html.count("<svg") == html.count("gz: Allan deviation before and after") == (library is None)
    assert ("orange numbers" in html) == (library is None)


def test_deviations_are_those_of_the_dictionary(analysis: imu_monitor.Analysis) -> None:
    gz, written = analysis["gz"], analysis.to_dict()["axes"]["gz"]
    for name in ("allan", "total", "hadamard"):
        np.testing.assert_array_equal(getattr(gz, name).deviation, np.array(written[name]["deviation"], np.float64))
    for symbol, one in gz.coefficients.items():
        assert one.status == written["coefficients"][symbol]["status"]
        assert one.value == pytest.approx(written["coefficients"][symbol]["value"] or np.nan, nan_ok=True)


def test_results_can_be_pickled(recording: imu_monitor.Recording, analysis: imu_monitor.Analysis) -> None:
    for one in (recording, analysis):
        assert str(pickle.loads(pickle.dumps(one))) == str(one)


# --- imports

FOREIGN_CHECK = """
import sys
before = list(sys.path)
import imu_monitor
assert "numpy" not in sys.modules and "numba" not in sys.modules
assert sys.path == before
recording = imu_monitor.simulate("mti-1", duration_s=10.0)
print(imu_monitor.analyze(recording)["gz"].coefficients["N"].status)
import monitor, drivers
print(monitor.__file__, drivers.__file__)
"""


@pytest.mark.parametrize("form", ["packages", "modules", "namespaces", "sitecustomize"])
def test_interface_works_behind_foreign_packages(form: str, tmp_path: Path) -> None:
    path = create_foreign_packages(tmp_path / "ros", form)
    environment = os.environ | {"PYTHONPATH": f"{path}{os.pathsep}{ROOT}"}
    done = subprocess.run(
        [sys.executable, "-c", FOREIGN_CHECK], cwd=path, env=environment, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    files = " ".join(str(ROOT / name / "__init__.py") for name in ("monitor", "drivers"))
    assert done.stdout == f"estimated\n{files}\n"


@pytest.mark.parametrize("form", ["sitecustomize"])
def test_tests_work_behind_foreign_packages(form: str, tmp_path: Path) -> None:
    path = create_foreign_packages(tmp_path / "ros", form)
    files = [str(ROOT / "tests" / name) for name in ("drivers/test_units.py", "drivers/test_irregular_files.py")]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", "-k", "units or command0", *files],
        cwd=ROOT, env=os.environ | {"PYTHONPATH": str(path)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    assert " passed" in done.stdout


def test_import_loads_only_the_standard_library() -> None:
    program = "import sys; before = set(sys.modules); import imu_monitor; print(*set(sys.modules) - before)"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    loaded = {name.partition(".")[0] for name in done.stdout.split()}
    assert loaded - sys.stdlib_module_names == {"imu_monitor"}
