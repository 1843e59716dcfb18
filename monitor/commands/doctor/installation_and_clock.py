"""Checks of the machine: library versions, import path, compiled kernels, system clock and systemd unit."""

import ctypes
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Final

from packaging.requirements import Requirement

from drivers.host.extras import install_command
from monitor.commands.doctor.finding import DoctorFinding, doubt, well, wrong

TIME_ERROR: Final = 5
"""Return value of adjtimex(2) if the clock is not synchronized."""


UNIT: Final = "imu-monitor.service"


PACKAGE: Final = "imu-monitor"


PACKAGES: Final = ("monitor", "drivers")
"""Packages of the program. Other packages may have the same names, because these names are common."""


UNCHECKED_EXTRAS: Final = ("test", "fuzz", "all")
"""Extras for developers, and the extra that includes all others."""


def check_library_versions() -> list[DoctorFinding]:
    """Check whether each installed library has a version that the program supports."""
    about, found, count = "libraries", [], 0
    for required, optional in library_requirements():
        install = install_command(f"{required.name}{required.specifier}")
        try:
            there = metadata.version(required.name)
        except metadata.PackageNotFoundError:
            if not optional:
                found.append(wrong(about, f"{required.name} is missing", install))
            continue
        count += 1
        if not required.specifier.contains(there, prereleases=True):
            text = f"{required.name} {there} is installed, {required.specifier} is required"
            found.append(wrong(about, text, install))
    if not found and not count:
        text = "the required versions are unknown, because the package imu-monitor is not installed"
        return [doubt(about, text)]
    return found or [well(about, f"Python {sys.version.split()[0]}, {count} libraries with the required versions")]


def library_requirements() -> Iterator[tuple[Requirement, bool]]:
    """Yield the required name and versions of each library, and whether the library is optional.

    Test libraries are omitted.
    """
    try:
        lines, extras = metadata.requires(PACKAGE) or [], metadata.metadata(PACKAGE).get_all("Provides-Extra") or []
    except metadata.PackageNotFoundError:
        return
    used = [{"extra": ""}, *({"extra": extra} for extra in extras if extra not in UNCHECKED_EXTRAS)]
    for required in map(Requirement, lines):
        fitting = [one for one in used if required.marker is None or required.marker.evaluate(one)]
        if required.name != PACKAGE and fitting:
            yield required, bool(fitting[0]["extra"])


def check_shadowed_packages(module_path: Sequence[str]) -> list[DoctorFinding]:
    """Check that no other module on the import path shadows a package of the program."""
    own = Path(__file__).resolve().parents[3]
    found = []
    for entry in module_path:
        folder = Path(entry or os.curdir).resolve()
        if folder == own:
            break
        for name in PACKAGES:
            # A folder without __init__.py is a namespace package. Python prefers a regular package on a later path.
            places = (folder / name / "__init__.py", folder / f"{name}.py")
            foreign = next((one for one in places if one.is_file()), None)
            if foreign is not None:
                text = (
                    f"{foreign}: is found before the program's own package {name}; imu-monitor uses its own, a script "
                    f"that imports {name} does not"
                )
                found.append(doubt("packages", text, f"remove {folder} from PYTHONPATH for such scripts"))
    return found or [well("packages", f"{' and '.join(PACKAGES)} are the program's own, in {own}")]


def check_kernels() -> DoctorFinding:
    """Check that the numerical kernels are compiled and stored."""
    from monitor.common.compiled import kernel_cache_folder
    from monitor.daemon.kernels.kernel_compilation import is_warm
    from monitor.daemon.kernels.kernel_groups import SERVICE

    folder = kernel_cache_folder()
    if folder is None:
        text = "no folder for compiled kernels is writable: every start compiles them again, for one or two minutes"
        return doubt("kernels", text, "set NUMBA_CACHE_DIR to a folder of the service's user")
    if not is_warm(SERVICE):
        text = f"not compiled for this version on this machine, in {folder}: the next start takes longer"
        return doubt("kernels", text, "run imu-monitor warm-up as the user of the service")
    return well("kernels", f"compiled, in {folder}")


def check_clock() -> DoctorFinding:
    """Check that the system clock is synchronized, because the results contain system times."""
    state = _adjtimex()
    if state is None:
        return doubt("clock", "the system does not report whether it is synchronised")
    if state == TIME_ERROR:
        text = "not synchronised: the times of results and recordings will drift, or jump when it is set"
        return doubt("clock", text, "timedatectl set-ntp true, or install chrony")
    return well("clock", "synchronised")


def _adjtimex() -> int | None:
    try:
        library = ctypes.CDLL(None, use_errno=True)
        question = ctypes.create_string_buffer(512)  # modes = 0 only reads the clock
        state = int(library.adjtimex(question))
    except (OSError, AttributeError, TypeError):
        return None
    return state if state >= 0 else None


def check_systemd_unit() -> list[DoctorFinding]:
    """Check the state of the systemd unit, if there is one."""
    if shutil.which("systemctl") is None or not Path("/run/systemd/system").is_dir():
        return []
    command = ["systemctl", "show", UNIT, "--property=LoadState,ActiveState,SubState,NRestarts,UnitFileState"]
    try:
        said = subprocess.run(command, capture_output=True, text=True, timeout=10.0, check=False).stdout
    except (OSError, subprocess.TimeoutExpired) as error:
        return [doubt("systemd", f"the state is unknown: {error}")]
    return check_systemd_unit_state(dict(line.split("=", 1) for line in said.splitlines() if "=" in line))


def check_systemd_unit_state(unit_properties: Mapping[str, str]) -> list[DoctorFinding]:
    """Return the findings about the properties that ``systemctl show`` prints. The list is empty if there is no unit.

    Examples
    --------
    >>> check_systemd_unit_state({"LoadState": "not-found"})
    []
    """
    if unit_properties.get("LoadState") != "loaded":
        return []
    state, restarts = unit_properties.get("ActiveState", ""), unit_properties.get("NRestarts", "0")
    enabled = unit_properties.get("UnitFileState", "")
    text = f"{UNIT}: {state} ({unit_properties.get('SubState', '')}), {restarts} restarts, {enabled}"
    if state == "failed":
        return [wrong("systemd", text, f"journalctl -u {UNIT} -e shows the reason")]
    if state != "active" or restarts != "0":
        return [doubt("systemd", text, f"journalctl -u {UNIT} -e; systemctl enable --now {UNIT}")]
    if enabled != "enabled":
        return [doubt("systemd", text, f"systemctl enable {UNIT}; otherwise it does not start with the machine")]
    return [well("systemd", text)]
