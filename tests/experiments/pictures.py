"""Make every picture of the viewer and of the plots in the documentation: ``python -m tests.experiments.pictures``.

The sensors are simulated, and the program draws everything else. ``Service`` replays a recording of the model
``consumer-mems`` into a native viewer without a screen, and into the web viewer in Chromium. ``analyze``, ``reconcile``
and ``compensate`` draw their own pictures. The devices of the fleet run in real time, and two cables are unplugged.
The packages chromium, mesa-vulkan-drivers and libvulkan1 are needed (names of Debian). Network traffic stays on
loopback.

    python -m tests.experiments.pictures [--out docs/pictures] [--only native surfaces temperature drift compensation …]
"""

import argparse
import base64
import contextlib
import io
import itertools
import json
import os
import secrets
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock
from urllib.parse import quote

import numpy as np

from drivers.data_types import Floats
from drivers.recordings import save_samples
from monitor.commands.reconcile import reconcile_and_write_report
from monitor.common import shipped_config_paths
from monitor.daemon.service import Service
from monitor.estimation.estimate import Estimate
from monitor.history.minute_aggregation import MinuteAggregator
from monitor.history.sqlite_store import FILE_NAME, HistoryFileWriter
from monitor.history.stored_events import StoredEvent
from monitor.noise.model import NoiseModel
from monitor.noise.model_loading import read_model
from monitor.publishing.plots.reconcile_figures import diagnostic_comparison_svg
from monitor.publishing.rerun import sinks
from monitor.publishing.rerun.fleet import FleetView
from monitor.publishing.rerun.queued_view import RerunView
from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription, ViewerSettings
from monitor.publishing.zenoh.subscriber import ZenohSubscriber
from monitor.reconcile.result import AxisResult
from monitor.settings import loading
from monitor.simulator import ports
from monitor.simulator.demo_config import build_demo_config
from monitor.simulator.encoding_sensor import AMBIENT_C, WARM_UP_C, WARM_UP_S
from tests.experiments.picture_sources import store_checksum
from tests.monitor.publishing.example_results import make_estimate, make_true_coefficients

SIZE = (1600, 1000)
MODEL = shipped_config_paths.CONFIG_FOLDER / "models" / "consumer-mems.toml"
T0 = 1_763_705_400.0  # Unix s of the first sample: 2025-11-21 06:10 UTC
HOUR_S = 3600.0
SPARE_S = 900.0  # additional length of the recording, so that the replay still runs when the service stops
GAP_S = (1403.0, 1404.5)  # since T0: gap in the recording
NOISE_STEP_S = 2400.0  # since T0: time at which gz becomes noisier
ADDED_N = 1.7e-4  # rad/√s: added white noise
WINDOW = "5min"
SPEED = 120.0
SETTLE_S = 6.0  # time for a software renderer to draw all data
UNCHANGED_S = 5.0  # a page that has not changed for this time shows all data
UNPLUGGED_S, PLUGGED_S, SECOND_UNPLUGGED_S, SCREENSHOT_S = 30.0, 34.0, 70.0, 74.0  # since the fleet's start
DEMO_LETTERS = (8e-6, 1.5e-4, 2e-4, 4e-5, 1e-9)  # Q N B K R of its gyros
VIBRATION = "gz.sinusoidal:amplitude=4e-3,frequency=17"
VIBRATION_S = 45.0  # after the vibration began
CHROMIUM_FLAGS = (
    *("--headless=new", "--no-sandbox", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--disable-default-apps"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),
    *("--hide-scrollbars", f"--window-size={SIZE[0]},{SIZE[1] + 143}"),
)
HIDDEN = """
[gz.narrowband]
sigma = 1.2e-3
frequency = 17.0
bandwidth = 2.0

[gz.outliers]
fraction = 2e-4
scale = 0.02
"""
TURNED_RECORDING_S, TURNS_S = 2700.0, (900.0, 1300.0, 1700.0)
WARM_S, WARM_HZ, WARM_SPEED = 48 * 3600.0, 10.0, 4000.0
WARM = """
[temperature]
mean = 24.0
swing = 3.0
period = 86400.0
wander = 0.3
wander_time = 7200.0

["g*".temperature_lag]
coefficient = 1.0e-5
reference = 24.0
time_constant = 5400.0

["a*".temperature_bias]
coefficient = 5.0e-4
reference = 24.0

[gz.bias_step]
time = 130000.0
height = 3.0e-5
"""
REPLAY = """
[[device]]
name = "bench-1"
rate = 100.0
driver = {{ link = "replay", path = "{recording}", speed = {speed} }}
"""
MEMBERS = tuple(f"{place}-{side}" for place in ("nose", "wing", "tail", "gear") for side in ("left", "mid", "right"))
MEMBER = """
[[device]]
name = "{name}"
rate = 100.0
driver = {{ link = "virtual", seed = {seed} }}
"""
FLEET = """
[[device]]
name = "nose"
rate = 100.0
driver = { link = "virtual", seed = 1 }

[[device]]
name = "tail"
rate = 100.0
driver = { link = "virtual", seed = 2, decoder = "xsens_mtdata2" }

[[device]]
name = "wing"
rate = 100.0
driver = { link = "virtual", seed = 3, decoder = "stim300" }
"""


def main() -> None:
    """Make the requested pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("docs/pictures"))
    parser.add_argument("--only", nargs="*", choices=PICTURES, default=list(PICTURES))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for name in arguments.only:
            path = PICTURES[name](arguments.out.resolve(), Path(folder))
            store_checksum(path)
            print(f"{path} ({path.stat().st_size / 1e3:.0f} kB)")


def native(out: Path, folder: Path) -> Path:
    """Show one device in the native viewer."""
    path = out / "viewer.png"
    with window() as (port, shoot):
        with serving(folder, replay(folder), port) as service:
            wait_until(lambda: has_replayed(service, HOUR_S), 300.0)
        time.sleep(SETTLE_S)
        shoot(path)
    return path


def surfaces(out: Path, folder: Path) -> Path:
    """Show the "What changed" page for a device whose noise has changed."""
    return show_changed_device(out / "viewer-dynamic.png", replay(folder, changed=True), folder, tab=1)


def gap(out: Path, folder: Path) -> Path:
    """Show the "Model gap" page for a device whose noise has changed."""
    devices = f'{replay(folder, changed=True)}model = "{MODEL}"\n'
    return show_changed_device(out / "viewer-gap.png", devices, folder, tab=4)


def show_changed_device(path: Path, devices: str, folder: Path, tab: int) -> Path:
    """Show a page of a device after its noise has changed."""
    with window() as (port, shoot):
        with serving(folder, devices, port) as service:
            wait_until(lambda: has_replayed(service, HOUR_S), 300.0)
        select_tab(port, tab)
        time.sleep(SETTLE_S)
        shoot(path)
    return path


def temperature(out: Path, folder: Path) -> Path:
    """Show the "Temperature" page for two days of data in which the bias of gz stepped once."""
    path = out / "viewer-temperature.png"
    source = folder / "warm.npz"
    model = read_model(shipped_config_paths.CONFIG_FOLDER / "models" / "stim300.toml") + NoiseModel.from_toml(WARM)
    n = round(WARM_S * WARM_HZ)
    drawn = model.start_stream(WARM_HZ, 1).draw_samples_with_temperature(n)
    save_samples(source, T0 + np.arange(n) / WARM_HZ, drawn.values, drawn.temperature_c)
    devices = REPLAY.format(recording=source, speed=WARM_SPEED).replace("rate = 100.0", f"rate = {WARM_HZ}")
    with window() as (port, shoot):
        with serving(folder, devices, port) as service:
            wait_until(lambda: has_replayed(service, WARM_S - 600.0), 300.0)
        select_tab(port, 2)
        time.sleep(SETTLE_S)
        shoot(path)
    return path


def drift(out: Path, folder: Path) -> Path:
    """Show the page "Drift" for a sensor that is turned three times."""
    path = out / "viewer-drift.png"
    source = folder / "turned.npz"
    n = round(TURNED_RECORDING_S * 100.0)
    t_s = np.arange(n) / 100.0
    values = (
        read_model(shipped_config_paths.CONFIG_FOLDER / "models" / "adis16470.toml")
        .start_stream(100.0, 1)
        .draw_samples_with_temperature(n)
        .values.copy()
    )
    for axis, since_s in enumerate(TURNS_S):
        turning = (t_s >= since_s) & (t_s < since_s + 60.0)
        values[turning, axis] += np.radians(1.0) * np.sin(2.0 * np.pi * (t_s[turning] - since_s) / 20.0)
    turning = t_s >= TURNED_RECORDING_S - 12.0
    values[turning, 2] += np.radians(1.0) * np.sin(2.0 * np.pi * (t_s[turning] - t_s[turning][0]) / 6.0)
    save_samples(source, T0 + t_s, values)
    with window() as (port, shoot):
        with serving(folder, REPLAY.format(recording=source, speed=SPEED), port) as service:
            wait_until(lambda: has_replayed(service, TURNED_RECORDING_S - 2.0), 120.0)
        select_tab(port, 2)  # the recording has no temperature, so there is no page for it
        time.sleep(SETTLE_S)
        shoot(path)
    return path


def compensation(out: Path, folder: Path) -> Path:
    """Draw the plot of ``imu-monitor compensate`` for three hours of a sensor at rest."""
    path, source = out / "compensate.png", folder / "still.npz"
    n = 1_080_000
    values = (
        read_model(shipped_config_paths.CONFIG_FOLDER / "models" / "adis16470.toml")
        .start_stream(100.0, 2)
        .draw_samples_with_temperature(n)
        .values
    )
    save_samples(source, np.arange(n) / 100.0, values)
    arguments = ["compensate", str(source), "--out", str(folder / "out.npz"), "--plot", str(path)]
    subprocess.run([sys.executable, "-m", "imu_monitor", *arguments], check=True)
    return path


def select_tab(port: int, tab: int) -> None:
    """Select a tab of the device in the viewer that listens on ``port``."""
    from rerun.experimental import ViewerClient

    viewer = ViewerClient(sinks.server_url(port))
    layout = viewer.get_blueprint().blueprint
    for part in layout.values():
        tabs = part.get("ContainerBlueprint", {})
        if "active_tab" in tabs and len(tabs["contents"]) > tab:
            tabs["active_tab"] = tabs["contents"][tab]
    viewer.set_blueprint(layout, of="recording")


def fleet(out: Path, folder: Path) -> Path:
    """Show the overview of three devices."""
    path = out / "viewer-fleet.png"
    with window() as (port, shoot), short_port_names(folder), serving(folder, FLEET, port) as service:
        simulated = {worker.name: worker.simulated for worker in service.workers}
        tail, wing = simulated["tail"], simulated["wing"]
        wait_until(lambda: all(worker.publisher.latest is not None for worker in service.workers), 120.0)
        begun_s = time.monotonic()
        for at_s, act in (
            (UNPLUGGED_S, tail.port.unplug),
            (PLUGGED_S, tail.port.plug),
            (SECOND_UNPLUGGED_S, wing.port.unplug),
            (SCREENSHOT_S, lambda: shoot(path)),
        ):
            time.sleep(max(begun_s + at_s - time.monotonic(), 0.0))
            act()
    return path


def view(out: Path, folder: Path) -> Path:
    """Show ``imu-monitor view`` with twelve devices; one of three daemons is stopped, and two cables are unplugged."""
    path = out / "view-fleet.png"
    with window() as (port, shoot), short_port_names(folder), contextlib.ExitStack() as stack:
        daemons, endpoints = [], []
        for daemon in range(3):
            endpoints.append(f"tcp/127.0.0.1:{free_port()}")
            file = folder / f"daemon{daemon}.toml"
            devices = "".join(
                MEMBER.format(name=name, seed=seed) for seed, name in enumerate(MEMBERS) if seed % 3 == daemon
            )
            rest = f'[zenoh]\nlisten = ["{endpoints[-1]}"]\nprefix = "fleet"\n[viewer]\nmode = "none"\n'
            file.write_text(devices + rest)
            daemons.append(stack.enter_context(running(loading.load_config(file))))
        detail = [f"fleet/{name}" for name in MEMBERS[:2]]
        viewer = RerunView(
            ViewerSettings("native", port), [ViewerDeviceDescription(key, "over zenoh") for key in detail], fleet=True
        )
        arriving = stack.enter_context(contextlib.closing(ZenohSubscriber("fleet/**", endpoints, None, detail)))
        stack.enter_context(contextlib.closing(viewer))
        stop = threading.Event()
        fleet_thread = threading.Thread(target=FleetView(arriving, viewer, detail).run, args=(stop, print))
        arriving.start()
        viewer.start()
        fleet_thread.start()
        try:
            wait_until(
                lambda: all(worker.publisher.latest is not None for service in daemons for worker in service.workers),
                120.0,
            )
            time.sleep(SECOND_UNPLUGGED_S)
            daemons[0].workers[1].simulated.port.unplug()  # MEMBERS[3]
            daemons[1].workers[1].simulated.port.unplug()  # MEMBERS[4]
            daemons[2].request_stop()
            time.sleep(SETTLE_S)
            shoot(path)
        finally:
            stop.set()
            fleet_thread.join()
    return path


def yesterday(out: Path, folder: Path) -> Path:
    """Show the viewer of a restarted daemon with the last day, of which one hour is missing."""
    path = out / "viewer-history.png"
    config = build_demo_config()
    (device,) = config.devices
    write_history(folder / "kept" / FILE_NAME, device.name, time.time())
    zenoh = config.zenoh.model_copy(update={"mode": "none"})
    storage = loading.Storage(folder=folder / "kept", record=False)
    with window() as (port, shoot):
        viewer = config.viewer.model_copy(update={"mode": "native", "port": port, "history": 86_400.0})
        with running(replace(config, zenoh=zenoh, viewer=viewer, storage=storage)) as service:
            wait_until(lambda: has_coefficients(service), 240.0)
            time.sleep(VIBRATION_S)
            shoot(path)
    return path


def has_coefficients(service: Service) -> bool:
    """Return True if the service has estimated coefficients."""
    latest = service.workers[0].publisher.latest
    return latest is not None and bool(np.isfinite(latest.fitted).any())


def write_history(path: Path, device: str, now_s: float) -> None:
    """Write a history of one day that ends ten minutes ago, with one shock and a changing temperature."""
    rng, minutes = np.random.default_rng(1), MinuteAggregator()
    rows = []
    wander = np.cumsum(0.004 * rng.standard_normal((1440, 6)), axis=0)
    for i in range(1430):
        if not 800 <= i < 860:
            scale = (1.0 + wander[i]) * (1.5 if i == 500 else 1.0)
            rows.append(minutes.add_estimate(now_s - 86_400.0 + 60.0 * i, scale_estimate(scale, rng)))
            rows.append(
                minutes.add_temperature(now_s - 86_400.0 + 60.0 * i, np.array([24.0 + 4.0 * np.sin(i / 229.0)]))
            )
    store = HistoryFileWriter(path)
    times = [now_s - 86_400.0 + 60.0 * i for i in (500, 800, 860)]
    texts = [("noise_changed", "gz angle random walk rose by 50 %"), ("link_lost", "/dev/ttyUSB0: gone"),
            ("link_back", "/dev/ttyUSB0: back after 1 h 00 min")]  # fmt: skip
    events = [StoredEvent(at, kind, text) for at, (kind, text) in zip(times, texts, strict=True)]
    store.write_rows_and_events(
        [(device, row) for row in (*rows, minutes.flush()) if row is not None], [(device, one) for one in events]
    )
    store.close()


def scale_estimate(scale: Floats, rng: np.random.Generator) -> Estimate:
    """Return the estimate of one hour of the demo's sensor, with one factor on the noise of each axis."""
    one = make_estimate(seed=int(rng.integers(1 << 30)))
    c = one.coefficients
    wanted = np.outer(DEMO_LETTERS, np.repeat([1.0, 10.0], 3)) * scale
    factor = np.divide(wanted, make_true_coefficients(), out=np.ones((5, 6)), where=make_true_coefficients() > 0.0)
    return replace(one, coefficients=replace(c, value=c.value * factor, lo=c.lo * factor, hi=c.hi * factor))


def effect(out: Path, _: Path) -> Path:
    """Show the demo after its sensor has begun to vibrate."""
    path = out / "demo-effect.png"
    config = build_demo_config(effects=[VIBRATION])
    zenoh = config.zenoh.model_copy(update={"mode": "none"})
    with window() as (port, shoot):
        viewer = config.viewer.model_copy(update={"mode": "native", "port": port})
        with running(replace(config, zenoh=zenoh, viewer=viewer)) as service:
            (sensor,) = [device.link for device in config.devices]
            assert isinstance(sensor, loading.VirtualTable)
            begun_s = time.monotonic()
            wait_until(lambda: service.workers[0].publisher.latest is not None, 60.0)
            time.sleep(begun_s + sensor.effect_at + VIBRATION_S - time.monotonic())
            shoot(path)
    return reduce_colours(path)


def web(out: Path, folder: Path) -> Path:
    """Show one device in the web viewer in Chromium."""
    with page_server() as (port, url), browser() as page:
        dark = [{"name": "prefers-color-scheme", "value": "dark"}]
        page.call("Emulation.setEmulatedMedia", features=dark)
        page.call("Page.navigate", url=url + "&renderer=webgl&hide_welcome_screen=1")
        with serving(folder, replay(folder), port) as service:
            wait_until(lambda: has_replayed(service, HOUR_S), 300.0)
        picture = settled_screenshot(page)
    path = out / "viewer-web.png"
    path.write_bytes(picture)
    return path


def allan(out: Path, folder: Path) -> Path:
    """Draw the plot of ``analyze --plot``."""
    return reduce_colours(run_analyze(recording(folder, HOUR_S), out / "allan-plot.png"))


def live_notebook(out: Path, folder: Path) -> Path:
    """Run the notebook about live data, and save its picture."""
    return save_notebook_pictures("live_data_over_zenoh", folder, out / "notebook-live.png")


def simulation_notebook(out: Path, folder: Path) -> Path:
    """Run the notebook about simulations, and save its pictures side by side."""
    return save_notebook_pictures("simulation_against_measurement", folder, out / "notebook-simulation.png")


def save_notebook_pictures(name: str, folder: Path, path: Path) -> Path:
    """Run a notebook of the documentation, and save all PNG pictures of its outputs side by side."""
    from PIL import Image

    from tests.support.notebooks import list_output_data, run_notebook

    source = Path(__file__).parents[2] / "docs" / "tutorials" / f"{name}.ipynb"
    with contextlib.chdir(folder):
        notebook, _ = run_notebook(source)
    encoded = [data["image/png"] for data in list_output_data(notebook) if "image/png" in data]
    shown = [Image.open(io.BytesIO(base64.b64decode(text))).convert("RGB") for text in encoded]
    whole = Image.new("RGB", (sum(one.width for one in shown), max(one.height for one in shown)), "white")
    for i, one in enumerate(shown):
        whole.paste(one, (sum(left.width for left in shown[:i]), 0))
    whole.save(path)
    return reduce_colours(path)


def dynamic(out: Path, folder: Path) -> Path:
    """Draw the plot of ``analyze --plot --window``."""
    return reduce_colours(
        run_analyze(recording(folder, HOUR_S, changed=True), out / "dynamic-plot.png", "--window", WINDOW)
    )


def report(out: Path, folder: Path) -> Path:
    """Show the page of ``analyze --plot`` in Chromium."""
    page = run_analyze(recording(folder, HOUR_S, changed=True), folder / "report.html", "--window", WINDOW)
    path = out / "report.png"
    with browser() as tab:
        tab.call("Page.navigate", url=page.as_uri())
        time.sleep(SETTLE_S)
        size = tab.call("Page.getLayoutMetrics")["cssContentSize"]
        whole = {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 1}
        shot = tab.call("Page.captureScreenshot", format="png", clip=whole, captureBeyondViewport=True)
    path.write_bytes(base64.b64decode(shot["data"]))
    return reduce_colours(path)


def before(out: Path, folder: Path) -> Path:
    """Draw gz with the shipped model, which does not contain the hidden effects."""
    return save_diagnostic_picture(reconcile_hidden_effects(folder), "start", out / "reconcile-before.png")


def after(out: Path, folder: Path) -> Path:
    """Draw gz with the model that reconcile wrote."""
    return save_diagnostic_picture(reconcile_hidden_effects(folder), "end", out / "reconcile-after.png")


def reconcile_hidden_effects(folder: Path) -> AxisResult:
    """Return the result of reconcile for gz, with the effects of HIDDEN in the recording."""
    source = folder / "hidden.npz"
    if not source.exists():
        model = read_model(MODEL) + NoiseModel.from_toml(HIDDEN)
        rate_hz = model.sample_rate_hz
        assert rate_hz is not None
        n = round(HOUR_S * rate_hz)
        save_samples(source, np.arange(n) / rate_hz, model.simulate(n, rate_hz, 1), None)
    return reconcile_and_write_report(source, read_model(MODEL), folder / "result").axes["gz"]


def save_diagnostic_picture(result: AxisResult, when: str, path: Path) -> Path:
    """Draw spectrum, Allan deviation and tails of one axis with one model, as in the report."""
    views = {view.diagnostic: view for view in getattr(result, when).plots}
    drawn = [
        diagnostic_comparison_svg([("", views[diagnostic])], result.axis, 5.2, 3.3)
        for diagnostic in ("psd", "allan", "tails")
    ]
    page = path.with_suffix(".html")
    style = "body{margin:8px;display:flex;font-family:sans-serif;background:white}svg{width:520px;height:330px}"
    page.write_text(f"<meta charset=utf-8><style>{style}</style>{''.join(drawn)}")
    with browser() as tab:
        tab.call("Page.navigate", url=page.as_uri())
        time.sleep(SETTLE_S)
        clip = {"x": 0, "y": 0, "width": 1590, "height": 350, "scale": 1}
        shot = tab.call("Page.captureScreenshot", format="png", clip=clip)
    page.unlink()
    path.write_bytes(base64.b64decode(shot["data"]))
    return reduce_colours(path)


def reduce_colours(path: Path) -> Path:
    """Reduce a picture to 256 colours, which makes the file three times smaller."""
    from PIL import Image

    with Image.open(path) as picture:
        few = picture.convert("RGB").quantize(256, kmeans=1, dither=Image.Dither.NONE)
    few.save(path, optimize=True)
    return path


def run_analyze(source: Path, plot: Path, *more: str) -> Path:
    """Run ``imu-monitor analyze --plot`` on a recording."""
    arguments = ["analyze", str(source), "--plot", str(plot), *more]
    subprocess.run([sys.executable, "-m", "imu_monitor", *arguments], check=True)
    return plot


PICTURES: dict[str, Callable[[Path, Path], Path]] = {
    "native": native,
    "surfaces": surfaces,
    "gap": gap,
    "temperature": temperature,
    "drift": drift,
    "compensation": compensation,
    "fleet": fleet,
    "view": view,
    "yesterday": yesterday,
    "effect": effect,
    "web": web,
    "plot": allan,
    "dynamic": dynamic,
    "report": report,
    "before": before,
    "after": after,
    "live_notebook": live_notebook,
    "simulation_notebook": simulation_notebook,
}


def recording(folder: Path, seconds: float, changed: bool = False) -> Path:
    """Return a recording of the simulated device with a gap. If ``changed`` is True, gz becomes noisier."""
    path = folder / f"bench-1_{seconds / 3600:g}h{'_changed' if changed else ''}.npz"
    if not path.exists():
        model = read_model(MODEL)
        rate_hz = model.sample_rate_hz
        assert rate_hz is not None
        since_s = np.arange(round(seconds * rate_hz)) / rate_hz
        values = model.start_stream(rate_hz, 1).draw_next_samples(since_s.size)
        if changed:
            after = since_s >= NOISE_STEP_S
            values[after, 2] += ADDED_N * rate_hz**0.5 * np.random.default_rng(1).standard_normal(after.sum())
        temperature_c = AMBIENT_C - WARM_UP_C * np.expm1(-since_s / WARM_UP_S)
        kept = (since_s < GAP_S[0]) | (since_s >= GAP_S[1])
        save_samples(path, T0 + since_s[kept], values[kept], temperature_c[kept])
    return path


def replay(folder: Path, changed: bool = False) -> str:
    """Return the configuration of one device that replays the recording."""
    return REPLAY.format(recording=recording(folder, HOUR_S + SPARE_S, changed), speed=SPEED)


def has_replayed(service: Service, seconds: float) -> bool:
    """Return True if the estimate contains this duration of the recording."""
    latest = service.workers[0].publisher.latest
    return latest is not None and latest.t_ns >= (T0 + seconds) * 1e9


@contextmanager
def serving(folder: Path, devices: str, port: int) -> Iterator[Service]:
    """Run the service with these devices and the viewer that listens on ``port``."""
    viewer = f'[viewer]\nmode = "native"\nport = {port}\n'
    path = folder / "pictures.toml"
    path.write_text(f'{devices}\n[zenoh]\nlisten = ["tcp/127.0.0.1:{free_port()}"]\n\n{viewer}')
    with running(loading.load_config(path)) as service:
        yield service


@contextmanager
def short_port_names(folder: Path) -> Iterator[None]:
    """Give the pseudo-terminals of simulated sensors short relative paths below ``folder``, which messages show."""
    numbers = itertools.count()

    def create_folder(prefix: str) -> str:
        name = Path(f"usb{next(numbers)}")
        name.mkdir()
        return str(name)

    with contextlib.chdir(folder), mock.patch.object(ports, "tempfile", SimpleNamespace(mkdtemp=create_folder)):
        yield


@contextmanager
def running(config: loading.Config) -> Iterator[Service]:
    """Run the service in a thread, and stop it at the end."""
    service = Service(config)
    thread = threading.Thread(target=service.run)
    thread.start()
    try:
        yield service
    finally:
        service.request_stop()
        thread.join(30.0)


@contextmanager
def window() -> Iterator[tuple[int, Callable[[Path], None]]]:
    """Run a native viewer without a screen; yield its port and a function that saves a screenshot."""
    from rerun.experimental import ViewerClient

    port = free_port()
    size = f"{SIZE[0]}x{SIZE[1]}"
    child = sinks.ViewerProcess([
        *("--bind", "127.0.0.1", "--port", str(port), "--headless", "--window-size", size, "--hide-welcome-screen")
    ])  # fmt: skip
    try:
        wait_until(lambda: sinks.is_listening(port), 30.0)
        yield port, lambda path: ViewerClient(sinks.server_url(port)).save_screenshot(str(path))
    finally:
        child.terminate()


@contextmanager
def page_server() -> Iterator[tuple[int, str]]:
    """Run the server of the web viewer; yield its port and the address of the page."""
    port, web_port = free_port(), free_port()
    child = sinks.ViewerProcess([
        *("--serve-web", "--bind", "127.0.0.1", "--port", str(port), "--web-viewer-port", str(web_port))
    ])  # fmt: skip
    try:
        wait_until(lambda: sinks.is_listening(port) and sinks.is_listening(web_port), 30.0)
        yield port, f"http://127.0.0.1:{web_port}/?url={quote(sinks.server_url(port), safe='')}"
    finally:
        child.terminate()


def wait_until(condition: Callable[[], bool], seconds: float) -> None:
    """Wait until the condition is true; raise TimeoutError if it takes too long."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"not within {seconds} s")
        time.sleep(0.05)


def free_port() -> int:
    """Return a free port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Page:
    """Tab of a browser, controlled by the DevTools protocol over a WebSocket (RFC 6455)."""

    def __init__(self, url: str) -> None:
        host, path = url.removeprefix("ws://").split("/", 1)
        name, port = host.split(":")
        self._socket = socket.create_connection((name, int(port)), 120.0)
        key = base64.b64encode(secrets.token_bytes(16)).decode()
        lines = (
            f"GET /{path} HTTP/1.1",
            f"Host: {host}",
            "Upgrade: websocket",
            "Connection: Upgrade",
            f"Sec-WebSocket-Key: {key}",
            "Sec-WebSocket-Version: 13",
        )
        self._socket.sendall(("\r\n".join(lines) + "\r\n\r\n").encode())
        self._in = self._socket.makefile("rb")
        while self._in.readline() not in (b"\r\n", b""):
            pass
        self._last = 0

    def call(self, method: str, **params: object) -> dict[str, Any]:
        """Send one command and return its result."""
        self._last += 1
        self._send(json.dumps({"id": self._last, "method": method, "params": params}).encode())
        while True:
            message = json.loads(self._receive())
            if message.get("id") == self._last:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error']}")
                return dict(message["result"])

    def _send(self, payload: bytes) -> None:
        mask = secrets.token_bytes(4)
        size = len(payload)
        head = bytes([0x81, 0x80 | size]) if size < 126 else bytes([0x81, 0xFE]) + size.to_bytes(2, "big")
        self._socket.sendall(head + mask + bytes(b ^ mask[i % 4] for i, b in enumerate(payload)))

    def _receive(self) -> bytes:
        whole = b""
        while True:
            first, second = self._in.read(2)
            size = second & 0x7F
            if size >= 126:
                size = int.from_bytes(self._in.read(2 if size == 126 else 8), "big")
            whole += self._in.read(size)
            if first & 0x80:
                return whole


def settled_screenshot(page: Page) -> bytes:
    """Return a screenshot of a page that no longer changes. A software renderer may be half a minute late."""
    before = b""
    for _ in range(24):
        picture = base64.b64decode(page.call("Page.captureScreenshot", format="png")["data"])
        if picture == before:
            return picture
        before = picture
        time.sleep(UNCHANGED_S)
    raise TimeoutError(f"the page still changes after {24 * UNCHANGED_S:.0f} s")


@contextmanager
def browser() -> Iterator[Page]:
    """Run Chromium without a screen; yield an empty page."""
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        raise FileNotFoundError("no chromium: install the package chromium")
    port = free_port()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        child = subprocess.Popen(
            [
                *(program, *CHROMIUM_FLAGS, f"--user-data-dir={profile}"),
                *("--remote-debugging-address=127.0.0.1", f"--remote-debugging-port={port}", "about:blank"),
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "NO_PROXY": "127.0.0.1"},
        )
        try:
            wait_until(lambda: sinks.is_listening(port), 30.0)
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list") as reply:
                tabs = [tab for tab in json.load(reply) if tab["type"] == "page"]
            yield Page(tabs[0]["webSocketDebuggerUrl"])
        finally:
            child.terminate()
            child.wait(10.0)


if __name__ == "__main__":
    main()
