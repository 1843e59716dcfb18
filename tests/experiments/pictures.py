"""Make every picture of the viewer and of the plots in the documentation: ``python -m tests.experiments.pictures``.

Nothing is drawn by hand. The shipped model ``consumer-mems``, with the temperature of a sensor that warms up, is
simulated into a recording; ``Service`` replays an hour of it sixty times as fast into a native viewer without a
screen (software Vulkan), then into the page inside a real Chromium, driven by its DevTools protocol, and is stopped
as by a signal; ``imu-monitor analyze`` makes the plot of the same hour. ``imu-monitor reconcile`` finds what was
hidden in an hour of the model, before and after. Curves over time, in the viewer, the picture and the page, are those
of the same hour with a gyroscope that becomes noisier. Bias beside temperature is that of two days of ``stim300``,
replayed faster still, drift that of ``adis16470``, which is turned now and then. The fleet are simulated devices in
real time; one cable is pulled and put back, another is pulled for good. ``demo --effect`` runs in real time too. Needs
the packages chromium, mesa-vulkan-drivers and libvulkan1 (Debian's names); network traffic stays on loopback.

    python -m tests.experiments.pictures [--out docs/pictures] [--only native surfaces temperature drift compensation …]
"""

import argparse
import base64
import contextlib
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
from typing import Any
from urllib.parse import quote

import msgspec
import numpy as np

from drivers.recordings import save_samples
from drivers.sample import Floats
from monitor.commands.reconcile import Request, run_reconciliation
from monitor.common import config_files
from monitor.daemon.service import Service
from monitor.estimation.estimate import Estimate
from monitor.history.minute_aggregation import MinuteAggregator
from monitor.history.sqlite_store import FILE_NAME, HistoryStore
from monitor.history.stored_events import StoredEvent
from monitor.noise.catalogue import read_model
from monitor.noise.model import NoiseModel
from monitor.publishing.plots.reconcile_chart import chart
from monitor.publishing.rerun import sinks
from monitor.publishing.rerun.fleet import FleetView
from monitor.publishing.rerun.view import RerunView
from monitor.publishing.rerun.viewer_settings import DeviceInfo, ViewerSettings
from monitor.publishing.zenoh.subscriber import ZenohSubscriber
from monitor.reconcile.result import AxisResult
from monitor.settings import loading
from monitor.simulator import AMBIENT_C, WARM_UP_C, WARM_UP_S
from monitor.simulator.demo import demo_config
from tests.monitor.publishing.made import estimate, true_coefficients

SIZE = (1600, 1000)
MODEL = config_files.CONFIG_FOLDER / "models" / "consumer-mems.toml"
T0 = 1_763_705_400.0  # Unix s of the first sample: 2025-11-21 06:10 UTC
HOUR_S = 3600.0
SPARE_S = 900.0  # of the recording beyond the hour, so that it still runs when the service is stopped
GAP_S = (1403.0, 1404.5)  # since T0: what the recording lost
CHANGED_S = 2400.0  # since T0: when gz becomes noisier
MORE_N = 1.7e-4  # rad/√s: so much white noise is added
WINDOW = "5min"
SPEED = 60.0
SETTLE_S = 6.0  # for a software renderer to paint what has arrived
STILL_S = 5.0  # a page that has not changed for so long has caught up with what was sent
PULLED_S, PLUGGED_S, PULLED_AGAIN_S, LOOKED_S = 30.0, 34.0, 70.0, 74.0  # since the fleet's start
DEMO_LETTERS = (8e-6, 1.5e-4, 2e-4, 4e-5, 1e-9)  # Q N B K R of its gyros
VIBRATION = "gz.sinusoidal:amplitude=4e-3,frequency=17"
SHOWN_S = 45.0  # after the vibration began
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
TURNED_S, TURNS_S = 2700.0, (900.0, 1300.0, 1700.0)
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
    """Make the pictures that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("docs/pictures"))
    parser.add_argument("--only", nargs="*", choices=PICTURES, default=list(PICTURES))
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for name in asked.only:
            path = PICTURES[name](asked.out.resolve(), Path(folder))
            print(f"{path} ({path.stat().st_size / 1e3:.0f} kB)")


def native(out: Path, folder: Path) -> Path:
    """One device in the native viewer."""
    path = out / "viewer.png"
    with window() as (port, shoot):
        with serving(folder, replay(folder), port) as service:
            until(lambda: replayed(service, HOUR_S), 300.0)
        time.sleep(SETTLE_S)
        shoot(path)
    return path


def surfaces(out: Path, folder: Path) -> Path:
    """The same viewer's tab with the curves over time, of a device that has changed."""
    path = out / "viewer-dynamic.png"
    with window() as (port, shoot):
        with serving(folder, replay(folder, changed=True), port) as service:
            until(lambda: replayed(service, HOUR_S), 300.0)
        turn_to(port, 1)
        time.sleep(SETTLE_S)
        shoot(path)
    return path


def temperature(out: Path, folder: Path) -> Path:
    """The tab with bias beside temperature, of two days on which gz stepped once."""
    path = out / "viewer-temperature.png"
    source = folder / "warm.npz"
    model = read_model(config_files.CONFIG_FOLDER / "models" / "stim300.toml") + NoiseModel.from_toml(WARM)
    n = round(WARM_S * WARM_HZ)
    drawn = model.stream(WARM_HZ, 1).draw_with_temperature(n)
    save_samples(source, T0 + np.arange(n) / WARM_HZ, drawn.values, drawn.temperature_c)
    devices = REPLAY.format(recording=source, speed=WARM_SPEED).replace("rate = 100.0", f"rate = {WARM_HZ}")
    with window() as (port, shoot):
        with serving(folder, devices, port) as service:
            until(lambda: replayed(service, WARM_S - 600.0), 300.0)
        turn_to(port, 2)
        time.sleep(SETTLE_S)
        shoot(path)
    return path


def drift(out: Path, folder: Path) -> Path:
    """The tab with rates before and after compensation, of a sensor that is turned now and then."""
    path = out / "viewer-drift.png"
    source = folder / "turned.npz"
    n = round(TURNED_S * 100.0)
    t_s = np.arange(n) / 100.0
    values = (
        read_model(config_files.CONFIG_FOLDER / "models" / "adis16470.toml")
        .stream(100.0, 1)
        .draw_with_temperature(n)
        .values.copy()
    )
    for axis, since_s in enumerate(TURNS_S):
        turning = (t_s >= since_s) & (t_s < since_s + 60.0)
        values[turning, axis] += np.radians(1.0) * np.sin(2.0 * np.pi * (t_s[turning] - since_s) / 20.0)
    turning = t_s >= TURNED_S - 12.0
    values[turning, 2] += np.radians(1.0) * np.sin(2.0 * np.pi * (t_s[turning] - t_s[turning][0]) / 6.0)
    save_samples(source, T0 + t_s, values)
    with window() as (port, shoot):
        with serving(folder, REPLAY.format(recording=source, speed=SPEED), port) as service:
            until(lambda: replayed(service, TURNED_S - 2.0), 120.0)
        turn_to(port, 3)
        time.sleep(SETTLE_S)
        shoot(path)
    return path


def compensation(out: Path, folder: Path) -> Path:
    """What ``imu-monitor compensate --plot`` makes of three hours of a sensor at rest."""
    path, source = out / "compensate.png", folder / "still.npz"
    n = 1_080_000
    values = (
        read_model(config_files.CONFIG_FOLDER / "models" / "adis16470.toml")
        .stream(100.0, 2)
        .draw_with_temperature(n)
        .values
    )
    save_samples(source, np.arange(n) / 100.0, values)
    arguments = ["compensate", str(source), "--out", str(folder / "out.npz"), "--plot", str(path)]
    subprocess.run([sys.executable, "-m", "monitor.cli", *arguments], check=True)
    return path


def turn_to(port: int, tab: int) -> None:
    """Show that tab of the device in the viewer that is open at ``port``."""
    from rerun.experimental import ViewerClient

    viewer = ViewerClient(sinks.server_url(port))
    layout = viewer.get_blueprint().blueprint
    for part in layout.values():
        tabs = part.get("ContainerBlueprint", {})
        if "active_tab" in tabs:
            tabs["active_tab"] = tabs["contents"][tab]
    viewer.set_blueprint(layout, of="recording")


def fleet(out: Path, folder: Path) -> Path:
    """Three devices: the overview."""
    path = out / "viewer-fleet.png"
    with window() as (port, shoot), serving(folder, FLEET, port) as service:
        tail, wing = service.virtual["tail"], service.virtual["wing"]
        until(lambda: all(station.latest is not None for station in service.workers), 120.0)
        begun_s = time.monotonic()
        for at_s, act in (
            (PULLED_S, tail.unplug),
            (PLUGGED_S, tail.plug),
            (PULLED_AGAIN_S, wing.unplug),
            (LOOKED_S, lambda: shoot(path)),
        ):
            time.sleep(max(begun_s + at_s - time.monotonic(), 0.0))
            act()
    return path


def view(out: Path, folder: Path) -> Path:
    """``imu-monitor view``: a dozen devices of three daemons, one of which is gone; two cables are pulled."""
    path = out / "view-fleet.png"
    with window() as (port, shoot), contextlib.ExitStack() as ending:
        daemons, places = [], []
        for daemon in range(3):
            places.append(f"tcp/127.0.0.1:{free_port()}")
            file = folder / f"daemon{daemon}.toml"
            devices = "".join(
                MEMBER.format(name=name, seed=seed) for seed, name in enumerate(MEMBERS) if seed % 3 == daemon
            )
            rest = f'[zenoh]\nlisten = ["{places[-1]}"]\nprefix = "fleet"\n[viewer]\nmode = "none"\n'
            file.write_text(devices + rest)
            daemons.append(ending.enter_context(running(loading.load(file))))
        detail = [f"fleet/{name}" for name in MEMBERS[:2]]
        viewer = RerunView(
            ViewerSettings("native", port), [DeviceInfo(key, "over zenoh") for key in detail], fleet=True
        )
        arriving = ending.enter_context(contextlib.closing(ZenohSubscriber("fleet/**", places, None, detail)))
        ending.enter_context(contextlib.closing(viewer))
        stop = threading.Event()
        looking = threading.Thread(target=FleetView(arriving, viewer, detail).run, args=(stop, print))
        arriving.start()
        viewer.start()
        looking.start()
        try:
            until(lambda: all(station.latest is not None for one in daemons for station in one.workers), 120.0)
            time.sleep(PULLED_AGAIN_S)
            daemons[0].virtual[MEMBERS[3]].unplug()
            daemons[1].virtual[MEMBERS[4]].unplug()
            daemons[2].stop()
            time.sleep(SETTLE_S)
            shoot(path)
        finally:
            stop.set()
            looking.join()
    return path


def yesterday(out: Path, folder: Path) -> Path:
    """A daemon that was started anew: its view opens on the last day, of which an hour is missing."""
    path = out / "viewer-history.png"
    config = demo_config()
    (device,) = config.devices
    remember(folder / "kept" / FILE_NAME, device.name, time.time())
    zenoh = msgspec.structs.replace(config.zenoh, mode="none")
    storage = loading.Storage(folder / "kept", record=False)
    with window() as (port, shoot):
        viewer = msgspec.structs.replace(config.viewer, mode="native", port=port, history=86_400.0)
        with running(replace(config, zenoh=zenoh, viewer=viewer, storage=storage)) as service:
            until(lambda: fitted(service), 240.0)
            time.sleep(SHOWN_S)
            shoot(path)
    return path


def fitted(service: Service) -> bool:
    """Whether there are coefficients."""
    latest = service.workers[0].latest
    return latest is not None and bool(np.isfinite(latest.fitted).any())


def remember(path: Path, device: str, now_s: float) -> None:
    """A day of rows that ends ten minutes ago, for a sensor like the demo's, that was knocked and got warm."""
    rng, minutes = np.random.default_rng(1), MinuteAggregator()
    rows = []
    wander = np.cumsum(0.004 * rng.standard_normal((1440, 6)), axis=0)
    for i in range(1430):
        if not 800 <= i < 860:
            scale = (1.0 + wander[i]) * (1.5 if i == 500 else 1.0)
            rows.append(minutes.add_estimate(now_s - 86_400.0 + 60.0 * i, like(scale, rng)))
            rows.append(
                minutes.add_temperature(now_s - 86_400.0 + 60.0 * i, np.array([24.0 + 4.0 * np.sin(i / 229.0)]))
            )
    store = HistoryStore(path)
    times = [now_s - 86_400.0 + 60.0 * i for i in (500, 800, 860)]
    told = [("noise_changed", "gz angle random walk rose by 50 %"), ("link_lost", "/dev/ttyUSB0: gone"),
            ("link_back", "/dev/ttyUSB0: back after 1 h 00 min")]  # fmt: skip
    events = [StoredEvent(at, kind, text) for at, (kind, text) in zip(times, told, strict=True)]
    store.add([(device, row) for row in (*rows, minutes.flush()) if row is not None], [(device, one) for one in events])
    store.close()


def like(scale: Floats, rng: np.random.Generator) -> Estimate:
    """What an hour of the demo's sensor gives, but for a factor an axis."""
    one = estimate(seed=int(rng.integers(1 << 30)))
    c = one.coefficients
    wanted = np.outer(DEMO_LETTERS, np.repeat([1.0, 10.0], 3)) * scale
    factor = np.divide(wanted, true_coefficients(), out=np.ones((5, 6)), where=true_coefficients() > 0.0)
    return replace(one, coefficients=replace(c, value=c.value * factor, lo=c.lo * factor, hi=c.hi * factor))


def effect(out: Path, _: Path) -> Path:
    """The demo, whose sensor has begun to vibrate."""
    path = out / "demo-effect.png"
    config = demo_config(effects=[VIBRATION])
    zenoh = msgspec.structs.replace(config.zenoh, mode="none")
    with window() as (port, shoot):
        viewer = msgspec.structs.replace(config.viewer, mode="native", port=port)
        with running(replace(config, zenoh=zenoh, viewer=viewer)) as service:
            (sensor,) = [device.link for device in config.devices]
            assert isinstance(sensor, loading.VirtualTable)
            begun_s = time.monotonic()
            until(lambda: service.workers[0].latest is not None, 60.0)
            time.sleep(begun_s + sensor.effect_at + SHOWN_S - time.monotonic())
            shoot(path)
    return small(path)


def web(out: Path, folder: Path) -> Path:
    """One device on the page, in Chromium."""
    with page_server() as (port, url), browser() as page:
        dark = [{"name": "prefers-color-scheme", "value": "dark"}]
        page.call("Emulation.setEmulatedMedia", features=dark)
        page.call("Page.navigate", url=url + "&renderer=webgl&hide_welcome_screen=1")
        with serving(folder, replay(folder), port) as service:
            until(lambda: replayed(service, HOUR_S), 300.0)
        picture = still(page)
    path = out / "viewer-web.png"
    path.write_bytes(picture)
    return path


def allan(out: Path, folder: Path) -> Path:
    """The plot that ``analyze --plot`` writes."""
    return small(analyzed(recording(folder, HOUR_S), out / "allan-plot.png"))


def dynamic(out: Path, folder: Path) -> Path:
    """The same with the curves over time."""
    return small(analyzed(recording(folder, HOUR_S, changed=True), out / "dynamic-plot.png", "--window", WINDOW))


def report(out: Path, folder: Path) -> Path:
    """The page that ``analyze --plot`` writes, in Chromium."""
    page = analyzed(recording(folder, HOUR_S, changed=True), folder / "report.html", "--window", WINDOW)
    path = out / "report.png"
    with browser() as tab:
        tab.call("Page.navigate", url=page.as_uri())
        time.sleep(SETTLE_S)
        size = tab.call("Page.getLayoutMetrics")["cssContentSize"]
        whole = {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 1}
        shot = tab.call("Page.captureScreenshot", format="png", clip=whole, captureBeyondViewport=True)
    path.write_bytes(base64.b64decode(shot["data"]))
    return small(path)


def before(out: Path, folder: Path) -> Path:
    """gz beside the shipped model, which does not know what was hidden."""
    return looked_at(hidden(folder), "start", out / "reconcile-before.png")


def after(out: Path, folder: Path) -> Path:
    """The same beside the model that reconcile wrote."""
    return looked_at(hidden(folder), "end", out / "reconcile-after.png")


def hidden(folder: Path) -> AxisResult:
    """What reconcile finds of HIDDEN."""
    source = folder / "hidden.npz"
    if not source.exists():
        model = read_model(MODEL) + NoiseModel.from_toml(HIDDEN)
        rate_hz = model.sample_rate_hz
        assert rate_hz is not None
        n = round(HOUR_S * rate_hz)
        save_samples(source, np.arange(n) / rate_hz, model.simulate(n, rate_hz, 1), None)
    return run_reconciliation(Request(source, read_model(MODEL), folder / "result")).axes["gz"]


def looked_at(result: AxisResult, when: str, path: Path) -> Path:
    """Spectrum, Allan deviation and tails of one axis beside one model, as the report draws them."""
    views = {view.lens: view for view in getattr(result, when).views}
    drawn = [chart([(lens, views[lens])], result.axis, 520.0, 330.0) for lens in ("psd", "allan", "tails")]
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
    return small(path)


def small(path: Path) -> Path:
    """The same picture in so many colours as a byte can tell, for the documentation: a third of its size."""
    from PIL import Image

    with Image.open(path) as picture:
        few = picture.convert("RGB").quantize(256, kmeans=1, dither=Image.Dither.NONE)
    few.save(path, optimize=True)
    return path


def analyzed(source: Path, plot: Path, *more: str) -> Path:
    """What ``imu-monitor analyze --plot`` makes of a recording."""
    arguments = ["analyze", str(source), "--plot", str(plot), *more]
    subprocess.run([sys.executable, "-m", "monitor.cli", *arguments], check=True)
    return plot


PICTURES: dict[str, Callable[[Path, Path], Path]] = {
    "native": native,
    "surfaces": surfaces,
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
}


def recording(folder: Path, seconds: float, changed: bool = False) -> Path:
    """So much of the simulated device, with a gap; the same at every run. ``changed``: gz becomes noisier."""
    path = folder / f"bench-1_{seconds / 3600:g}h{'_changed' if changed else ''}.npz"
    if not path.exists():
        model = read_model(MODEL)
        rate_hz = model.sample_rate_hz
        assert rate_hz is not None
        since_s = np.arange(round(seconds * rate_hz)) / rate_hz
        values = model.stream(rate_hz, 1).draw(since_s.size)
        if changed:
            after = since_s >= CHANGED_S
            values[after, 2] += MORE_N * rate_hz**0.5 * np.random.default_rng(1).standard_normal(after.sum())
        temperature_c = AMBIENT_C - WARM_UP_C * np.expm1(-since_s / WARM_UP_S)
        kept = (since_s < GAP_S[0]) | (since_s >= GAP_S[1])
        save_samples(path, T0 + since_s[kept], values[kept], temperature_c[kept])
    return path


def replay(folder: Path, changed: bool = False) -> str:
    """The configuration of one device that replays it."""
    return REPLAY.format(recording=recording(folder, HOUR_S + SPARE_S, changed), speed=SPEED)


def replayed(service: Service, seconds: float) -> bool:
    """Whether so much of the recording is in the estimate."""
    latest = service.workers[0].latest
    return latest is not None and latest.t_ns >= (T0 + seconds) * 1e9


@contextmanager
def serving(folder: Path, devices: str, port: int) -> Iterator[Service]:
    """The service with these devices, showing them in the viewer that is open at ``port``; stopped at the end."""
    viewer = f'[viewer]\nmode = "native"\nport = {port}\n'
    path = folder / "pictures.toml"
    path.write_text(f'{devices}\n[zenoh]\nlisten = ["tcp/127.0.0.1:{free_port()}"]\n\n{viewer}')
    with running(loading.load(path)) as service:
        yield service


@contextmanager
def running(config: loading.Config) -> Iterator[Service]:
    """The service in a thread of its own; stopped at the end."""
    service = Service(config)
    thread = threading.Thread(target=service.run)
    thread.start()
    try:
        yield service
    finally:
        service.stop()
        thread.join(30.0)


@contextmanager
def window() -> Iterator[tuple[int, Callable[[Path], None]]]:
    """A native viewer without a screen: its port, and what takes its picture."""
    from rerun.experimental import ViewerClient

    port = free_port()
    size = f"{SIZE[0]}x{SIZE[1]}"
    child = sinks.ViewerProcess([
        *("--bind", "127.0.0.1", "--port", str(port), "--headless", "--window-size", size, "--hide-welcome-screen")
    ])  # fmt: skip
    try:
        until(lambda: sinks.listens(port), 30.0)
        yield port, lambda path: ViewerClient(sinks.server_url(port)).save_screenshot(str(path))
    finally:
        child.end()


@contextmanager
def page_server() -> Iterator[tuple[int, str]]:
    """What serves the page, as mode "web" starts it, but for it to stay when the service stops: its port, the page."""
    port, web_port = free_port(), free_port()
    child = sinks.ViewerProcess([
        *("--serve-web", "--bind", "127.0.0.1", "--port", str(port), "--web-viewer-port", str(web_port))
    ])  # fmt: skip
    try:
        until(lambda: sinks.listens(port) and sinks.listens(web_port), 30.0)
        yield port, f"http://127.0.0.1:{web_port}/?url={quote(sinks.server_url(port), safe='')}"
    finally:
        child.end()


def until(true: Callable[[], bool], seconds: float) -> None:
    """Wait for it, or fail."""
    end = time.monotonic() + seconds
    while not true():
        if time.monotonic() > end:
            raise TimeoutError(f"not within {seconds} s")
        time.sleep(0.05)


def free_port() -> int:
    """A port that nobody holds right now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Page:
    """One tab of a browser, spoken to by the DevTools protocol over a WebSocket (RFC 6455)."""

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


def still(page: Page) -> bytes:
    """Its picture once it has caught up: on a software renderer it may be half a minute behind."""
    before = b""
    for _ in range(24):
        picture = base64.b64decode(page.call("Page.captureScreenshot", format="png")["data"])
        if picture == before:
            return picture
        before = picture
        time.sleep(STILL_S)
    raise TimeoutError(f"the page still changes after {24 * STILL_S:.0f} s")


@contextmanager
def browser() -> Iterator[Page]:
    """A Chromium without a screen, on an empty page."""
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
            until(lambda: sinks.listens(port), 30.0)
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list") as reply:
                tabs = [tab for tab in json.load(reply) if tab["type"] == "page"]
            yield Page(tabs[0]["webSocketDebuggerUrl"])
        finally:
            child.terminate()
            child.wait(10.0)


if __name__ == "__main__":
    main()
