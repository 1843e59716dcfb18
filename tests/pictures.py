"""Makes every picture of the viewer and of the plots that the documentation shows: ``python -m tests.pictures``.

Everything goes the way it goes in use: results are handed to ``RerunView``, which draws them in a native
viewer without a screen (software Vulkan) and in the web viewer inside a real Chromium, driven by its DevTools
protocol. Needs the packages chromium, mesa-vulkan-drivers and libvulkan1 (Debian's names); network traffic stays
on loopback. The device is made by hand from the five-term formula, the same at every run.

    python -m tests.pictures [--out docs/pictures] [--only native fleet web plot]
"""

import argparse
import base64
import json
import os
import secrets
import shutil
import socket
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from drivers.sample import Event
from monitor.publish import plot, rerun_sinks
from monitor.publish.rerun_view import RerunView
from monitor.publish.viewer import DeviceInfo, ViewerSettings
from tests.monitor.publish import made

SIZE = (1600, 1000)
T0 = 1_763_704_800.0  # Unix s: a round hour
LENGTH_S = 3600.0
SETTLE_S = 8.0  # for a software renderer to paint what has arrived
CHROMIUM_FLAGS = (
    *("--headless=new", "--no-sandbox", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--disable-default-apps"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),
    *("--hide-scrollbars", f"--window-size={SIZE[0]},{SIZE[1] + 143}"),
)


def main() -> None:
    """Make the pictures that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("docs/pictures"))
    parser.add_argument("--only", nargs="*", choices=PICTURES, default=list(PICTURES))
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    for name in asked.only:
        path = PICTURES[name](asked.out.resolve())
        print(f"{path} ({path.stat().st_size / 1e3:.0f} kB)")


def native(out: Path) -> Path:
    """One device in the native viewer."""
    return _native(out / "viewer.png", [DeviceInfo("bench-1", "stim300 on /dev/ttyUSB0")])


def fleet(out: Path) -> Path:
    """Three devices: the overview."""
    return _native(out / "viewer-fleet.png", [DeviceInfo(name) for name in ("bench-1", "bench-2", "wing")])


def web(out: Path) -> Path:
    """One device on the page, in Chromium."""
    port, web_port = free_port(), free_port()
    view = RerunView(ViewerSettings("web", port, web_port), [DeviceInfo("bench-1", "stim300 on /dev/ttyUSB0")])
    view.start()
    try:
        until(lambda: view.state == "ok", 30.0)
        feed(view, ["bench-1"])
        with browser() as page:
            dark = [{"name": "prefers-color-scheme", "value": "dark"}]
            page.call("Emulation.setEmulatedMedia", features=dark)
            page.call("Page.navigate", url=view.url + "&renderer=webgl&hide_welcome_screen=1")
            time.sleep(45.0)  # WebAssembly of 40 MB on a software renderer
            shot = page.call("Page.captureScreenshot", format="png")
    finally:
        view.close()
    path = out / "viewer-web.png"
    path.write_bytes(base64.b64decode(shot["data"]))
    return path


def allan(out: Path) -> Path:
    """The plot that ``analyze --plot`` writes."""
    path = out / "allan-plot.png"
    plot.allan_plot(made.estimate(T0, seconds=LENGTH_S, seed=7), path, title="bench-1, 1 h at 100 Hz")
    return path


PICTURES: dict[str, Callable[[Path], Path]] = {"native": native, "fleet": fleet, "web": web, "plot": allan}


def _native(path: Path, devices: list[DeviceInfo]) -> Path:
    from rerun.experimental import ViewerClient

    port = free_port()
    size = f"{SIZE[0]}x{SIZE[1]}"
    child = rerun_sinks.Child([
        *("--bind", "127.0.0.1", "--port", str(port), "--headless", "--window-size", size, "--hide-welcome-screen")
    ])  # fmt: skip
    view = RerunView(ViewerSettings("native", port), devices)
    try:
        until(lambda: rerun_sinks.listens(port), 30.0)
        view.start()
        until(lambda: view.state == "ok", 30.0)
        feed(view, [d.name for d in devices])
        time.sleep(SETTLE_S)
        ViewerClient(rerun_sinks.server_url(port)).save_screenshot(str(path))
    finally:
        view.close()
        child.end()
    return path


def feed(view: RerunView, devices: list[str]) -> None:
    """An hour of each device, as fast as it goes: courses, temperature, the last minute's samples, events."""
    for k, device in enumerate(devices):
        now = T0 + LENGTH_S
        scale = 1.0 + 0.35 * k
        for i in range(30, int(LENGTH_S) + 1, 30):
            view.estimate(
                device, T0 + i, made.estimate(T0 + i, seconds=float(i), scale=scale, seed=7 if i == 3600 else i)
            )
        t = T0 + np.arange(0.0, LENGTH_S, 5.0)
        view.samples(device, t, np.full((t.size, 6), np.nan), 31.0 + 1.5 * (1 - np.exp(-(t - T0) / 900.0)))
        raw_t, raw, _ = made.samples(now - 60.0, 60.0, seed=k)
        view.samples(device, raw_t, raw, np.full(raw_t.size, np.nan))
        view.event(device, T0 + 4.0, Event("link_back", 0, "link back after 3.2 s"))
        change = "gz angle random walk rose by 12 %"
        view.event(device, T0 + 1815.0, Event("noise_changed", 0, change, axis="gz"))
        view.health(device, now, made.health(uptime_s=LENGTH_S))


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
            until(lambda: rerun_sinks.listens(port), 30.0)
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list") as reply:
                tabs = [tab for tab in json.load(reply) if tab["type"] == "page"]
            yield Page(tabs[0]["webSocketDebuggerUrl"])
        finally:
            child.terminate()
            child.wait(10.0)


if __name__ == "__main__":
    main()
