"""Tests of the sdist and the wheel: contents, metadata, and the program and the Python interface of the wheel alone."""

import os
import re
import subprocess
import sys
import tarfile
import zipfile
from email import message_from_bytes
from email.message import Message
from pathlib import Path

import pytest

from hatch_build import make_links_absolute

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the sdist, and the wheel from the sdist, without access to a package index."""
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    subprocess.run(command, check=True, capture_output=True)
    return folder


@pytest.fixture(scope="module")
def wheel(packages: Path) -> zipfile.ZipFile:
    (path,) = packages.glob("*.whl")
    return zipfile.ZipFile(path)


@pytest.fixture(scope="module")
def metadata(wheel: zipfile.ZipFile) -> Message:
    (name,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    return message_from_bytes(wheel.read(name))


def test_sdist_and_wheel_pass_the_check_of_twine(packages: Path) -> None:
    files = [str(path) for path in packages.iterdir()]
    assert len(files) == 2
    subprocess.run([sys.executable, "-m", "twine", "check", "--strict", *files], check=True, capture_output=True)


def test_description_has_only_absolute_links_and_pictures(metadata: Message) -> None:
    text = str(metadata.get_payload(decode=True), "utf-8")  # type: ignore[arg-type]
    targets = re.findall(r"\]\(([^)]+)\)", text)
    assert len(targets) > 50
    assert all(target.startswith(("https://", "#")) for target in targets)
    pictures = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)
    assert pictures
    for picture in pictures:
        assert (ROOT / "docs" / picture.partition("/docs/")[2]).is_file()


@pytest.mark.parametrize("text", ["[a](https://host.example/x)", "![a](https://host.example/x.png)", "[a](#part)"])
def test_absolute_links_are_not_changed(text: str) -> None:
    assert make_links_absolute(text, "https://host.example", "v1") == text


def test_wheel_contains_every_package_and_its_types(wheel: zipfile.ZipFile, metadata: Message) -> None:
    names = set(wheel.namelist())
    assert {f"{package}/py.typed" for package in ("imu_monitor", "monitor", "drivers")} <= names
    assert "config/models/mti-1.toml" in names
    assert {name.partition("/")[0].partition("-")[0] for name in names} == {
        "imu_monitor", "monitor", "drivers", "config",
    }  # fmt: skip
    assert "Typing :: Typed" in metadata.get_all("Classifier", [])
    assert {line.partition(",")[0] for line in metadata.get_all("Project-URL", [])} >= {"Source", "Documentation"}


def test_upload_is_refused_while_the_addresses_are_placeholders(metadata: Message) -> None:
    placeholder = any(".example/" in address for address in metadata.get_all("Project-URL", []))
    assert ("Private :: Do Not Upload" in metadata.get_all("Classifier", [])) == placeholder


def test_sdist_contains_what_the_wheel_and_the_tests_need(packages: Path) -> None:
    (path,) = packages.glob("*.tar.gz")
    with tarfile.open(path) as sdist:
        names = {name.partition("/")[2] for name in sdist.getnames()}
    assert {"hatch_build.py", "pyproject.toml", "README.md", "LICENSE", "tests/test_packaging.py"} <= names


def test_wheel_alone_runs_the_program_and_the_interface(wheel: zipfile.ZipFile, tmp_path: Path) -> None:
    site = tmp_path / "site-packages"
    wheel.extractall(site)
    environment = os.environ | {"PYTHONPATH": str(site)}
    code = 'import imu_monitor; print(imu_monitor.__file__); print(repr(imu_monitor.simulate("mti-1", 10.0)))'
    for arguments, word in (
        (("-c", code), "<Recording of gx gy gz ax ay az: 1000 samples, 10 s>"),
        (("-m", "imu_monitor", "check", str(site / "config" / "demo.toml")), "no mistakes"),
    ):
        done = subprocess.run(
            [sys.executable, *arguments], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
        )
        assert word in done.stdout
        assert done.stdout.startswith(str(site)) or "check" in arguments
