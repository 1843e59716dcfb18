"""Fleet of daemons with three routers and one watcher on this machine: states, detection of a kill, traffic and load.

Each daemon is ``imu-monitor run`` in a separate process with a simulated sensor. The daemons connect alternately to two
leaf routers, and the watcher connects to the root router. If possible, everything runs in a separate network namespace,
so that the counters of the interface ``lo`` contain no other traffic.

    python -m tests.experiments.benchmarks.fleet [--daemons 50] [--seconds 30] [--rate 10] [--publish "1 Hz"]
    python -m tests.experiments.benchmarks.fleet --settings    bytes/s by topic, for several settings
"""

import argparse
import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import psutil
import zenoh

from drivers.zenoh.session_config import build_session_config
from monitor.publishing.remote_device_states import RemoteDeviceRegistry
from monitor.publishing.zenoh.subscriber import ZenohSubscriber
from tests.support.ports import free_port

PATIENCE_S: Final = 600.0
PARALLEL_STARTS: Final = 4
"""Number of daemons that start at the same time."""
NAMESPACE_VARIABLE: Final = "IMU_MONITOR_BENCH_NAMESPACE"
DAEMON: Final = """
[[device]]
name = "imu{i}"
rate = {rate}
window = "10min"
refit = "{publish}"
publish = "{publish}"
driver = {{ link = "virtual", seed = {i}, model = "{model}" }}
[zenoh]
listen = []
connect = ["{router}"]
[viewer]
mode = "none"
[log]
level = "error"
"""
MODEL: Final = """
sample_rate = {rate}
["g*".angle_random_walk]
N = 1.5e-4
["g*".bias_instability]
B = 4.0e-5
["a*".angle_random_walk]
N = 6.0e-4
"""
SETTINGS: Final = ((10, "1 Hz"), (100, "1 Hz"), (100, "10 Hz"), (1000, "10 Hz"), (1000, "every block"))


class Process:
    """Child process with its processor time and memory."""

    def __init__(self, *arguments: str) -> None:
        self._child = subprocess.Popen(
            [sys.executable, *arguments], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        self.seen = psutil.Process(self._child.pid)

    def cpu_s(self) -> float:
        """Return the processor time so far in seconds."""
        t = self.seen.cpu_times()
        return float(t.user + t.system)

    def memory_bytes(self) -> int:
        """Return the memory that the process does not share with other processes."""
        return int(self.seen.memory_full_info().uss)

    def end(self, number: int = signal.SIGTERM) -> None:
        """Send a signal and wait for the end of the process."""
        if self._child.poll() is None:
            self._child.send_signal(number)
            try:
                self._child.wait(20.0)
            except subprocess.TimeoutExpired:
                self._child.kill()
                self._child.wait()
        for pipe in (self._child.stdin, self._child.stderr):
            assert pipe is not None
            pipe.close()


@contextlib.contextmanager
def start_routers() -> Iterator[tuple[str, list[str], list[Process]]]:
    """Start three routers. Yield the endpoint of the root, the endpoints of the leaves, and the processes."""
    root, *leaves = (f"tcp/127.0.0.1:{free_port()}" for _ in range(3))
    processes = [Process("-m", "tests.experiments.benchmarks.fleet", "--router", root)]
    processes += [Process("-m", "tests.experiments.benchmarks.fleet", "--router", leaf, root) for leaf in leaves]
    try:
        yield root, leaves, processes
    finally:
        for process in processes:
            process.end()


def run_router(endpoint: str, *above: str) -> None:
    """Run a router in this process until standard input ends."""
    own: dict[str, Any] = {"mode": "router", "listen/endpoints": [endpoint], "connect/endpoints": list(above)}
    own["connect/timeout_ms"] = -1  # the root may start later
    own["transport/shared_memory/enabled"] = False  # with shared memory, long messages would not pass the interface
    with zenoh.open(build_session_config(own)):
        while sys.stdin.readline():
            pass


def start_daemon(
    folder: Path, router: str, i: int, rate: float, publish: str, window: str = "10min", more: str = ""
) -> Process:
    """Start ``imu-monitor run`` with one device."""
    path, model = folder / f"{i}.toml", folder / f"{i}.model.toml"
    model.write_text(MODEL.format(rate=float(rate)))
    path.write_text(DAEMON.format(i=i, rate=rate, publish=publish, router=router, model=model))
    return Process("-m", "imu_monitor", "run", str(path))


class Watcher:
    """Device states as in ``watch``, and the times at which liveliness tokens disappeared."""

    def __init__(self, endpoint: str) -> None:
        self.subscriber = ZenohSubscriber("imu/**", [endpoint])
        self.registry = RemoteDeviceRegistry()
        self.gone_s: dict[str, float] = {}
        self.messages: Counter[str] = Counter()
        self.bytes: Counter[str] = Counter()
        self.subscriber.start()

    def take(self, wait_s: float = 0.05) -> None:
        """Process the messages that have arrived."""
        for message in self.subscriber.take(wait_s):
            topic = message.key.rpartition("/")[2]
            self.messages[topic] += 1
            self.bytes[topic] += len(message.payload or b"")
            if message.payload is None:
                self.registry.set_liveliness_token(message.key, message.token_exists)
                if not message.token_exists:
                    self.gone_s[message.key] = time.monotonic()
            else:
                self.registry.process_message(message.key, message.payload)

    def until(self, condition: Callable[[], bool], what: str) -> float:
        """Process messages until the condition is true, and return the elapsed time in seconds."""
        begun_s = time.monotonic()
        while not condition():
            if time.monotonic() - begun_s > PATIENCE_S:
                raise SystemExit(f"waited {PATIENCE_S:.0f} s for {what}")
            self.take()
        return time.monotonic() - begun_s

    def states(self) -> Counter[str]:
        """Return the number of devices in each state."""
        now_s = time.monotonic()
        return Counter(device.state(now_s) for device in self.registry.devices_with_problems_first(now_s))


def run_fleet(daemons: int, rate: float, publish: str, seconds: float) -> dict[str, Any]:
    """Run a fleet and return all measurements."""
    with (
        tempfile.TemporaryDirectory() as name,
        start_routers() as (root, leaves, router_processes),
        contextlib.ExitStack() as stack,
    ):
        watcher = Watcher(root)
        stack.callback(watcher.subscriber.close)
        running = []
        begun_s = time.monotonic()
        for i in range(daemons):
            running.append(start_daemon(Path(name), leaves[i % 2], i, rate, publish))
            stack.callback(running[-1].end)
            if (i + 1) % PARALLEL_STARTS == 0 or i + 1 == daemons:
                watcher.until(lambda n=i + 1: watcher.states()["running"] == n, f"{i + 1} daemons")  # type: ignore[misc]
        started_s = time.monotonic() - begun_s
        found = {"daemons": daemons, "rate": rate, "publish": publish, "all running after s": round(started_s, 1)}
        found |= _measure_traffic(watcher, running, router_processes, seconds)
        found |= _kill_daemon(watcher, running[daemons // 2], f"imu/imu{daemons // 2}/alive")
        return found


def _measure_traffic(
    watcher: Watcher, running: list[Process], router_processes: list[Process], seconds: float
) -> dict[str, Any]:
    """Measure traffic and processor time after all daemons have started and compiled their kernels."""
    watcher.until(lambda: watcher.states()["running"] == len(running), "all to run")
    settle_s = time.monotonic() + 0.5 * seconds
    watcher.until(lambda: time.monotonic() > settle_s, "quiet")
    watcher.messages.clear()
    watcher.bytes.clear()
    n, this_process = len(running), psutil.Process()
    before, begun_s, own_s = (
        [p.cpu_s() for p in (*running, *router_processes)],
        time.monotonic(),
        sum(this_process.cpu_times()[:2]),
    )
    lo = _loopback_bytes()
    watcher.until(lambda: time.monotonic() - begun_s > seconds, "the measurement")
    took_s = time.monotonic() - begun_s
    lo = _loopback_bytes() - lo
    cpu = [(after.cpu_s() - b) / took_s for after, b in zip((*running, *router_processes), before, strict=True)]
    memory = sorted(p.memory_bytes() for p in running)
    # on a busy machine a daemon may have been silent for a moment
    watcher.until(lambda: watcher.states()["running"] == n, "all to run after the measurement")
    seen = dict(watcher.states())
    return {
        "seen": seen,
        "payload bytes/s of a device": {topic: round(size / took_s / n, 1) for topic, size in watcher.bytes.items()},
        "messages/s of a device": {topic: round(count / took_s / n, 2) for topic, count in watcher.messages.items()},
        "loopback bytes/s of a device, three hops": round(lo / took_s / n),
        "loopback counts nothing else": bool(os.environ.get(NAMESPACE_VARIABLE)),
        "processor of a daemon, % of a core": {
            "median": round(100 * sorted(cpu[:n])[n // 2], 2),
            "most": round(100 * max(cpu[:n]), 2),
        },
        "processor of the routers, % of a core": [round(100 * share, 2) for share in cpu[n:]],
        "processor of the watcher, % of a core": round(100 * (sum(this_process.cpu_times()[:2]) - own_s) / took_s, 2),
        "memory of a daemon, MB": {"median": round(memory[n // 2] / 1e6), "most": round(memory[-1] / 1e6)},
        "memory of a router, MB": [round(p.memory_bytes() / 1e6) for p in router_processes],
        "dropped": watcher.subscriber.dropped,
    }


def _kill_daemon(watcher: Watcher, victim: Process, key: str) -> dict[str, Any]:
    """Kill one daemon, and return the delays until its token disappears and the table shows it."""
    watcher.take(0.0)
    watcher.gone_s.clear()
    before = watcher.states()["gone"]
    killed_s = time.monotonic()
    victim.seen.kill()
    shown_s = watcher.until(lambda: watcher.states()["gone"] > before, "the killed one to be missed")
    return {
        "killed": {"token gone after s": round(watcher.gone_s[key] - killed_s, 3), "shown after s": round(shown_s, 3)}
    }


def measure_settings(seconds: float) -> list[dict[str, Any]]:
    """Print the payload bytes per second of one device by topic for several settings."""
    rows = []
    for rate, publish in SETTINGS:
        with (
            tempfile.TemporaryDirectory() as name,
            start_routers() as (root, leaves, _),
            contextlib.ExitStack() as stack,
        ):
            process = start_daemon(Path(name), leaves[0], 0, rate, publish)
            stack.callback(process.end)
            own = {"mode": "client", "connect/endpoints": [root], "connect/timeout_ms": -1}
            session: Any = stack.enter_context(zenoh.open(build_session_config(own)))
            subscriber: Any = session.declare_subscriber("imu/**", zenoh.handlers.RingChannel(100_000))
            channel = subscriber.handler
            _wait_for_coefficients(channel)
            time.sleep(seconds)
            while channel.try_recv() is not None:
                pass
            size: Counter[str] = Counter()
            lo, begun_s, cpu_s = _loopback_bytes(), time.monotonic(), process.cpu_s()
            while time.monotonic() - begun_s < seconds:
                sample = channel.try_recv()
                if sample is None:
                    time.sleep(0.002)
                else:
                    size[str(sample.key_expr).rpartition("/")[2]] += len(bytes(sample.payload))
            took_s = time.monotonic() - begun_s
            rows.append({
                "rate": rate,
                "publish": publish,
                "payload bytes/s": {topic: round(n / took_s) for topic, n in sorted(size.items())},
                "one hop with all headers, bytes/s": round((_loopback_bytes() - lo) / took_s / 3),
                "processor, % of a core": round(100 * (process.cpu_s() - cpu_s) / took_s, 1),
            })  # fmt: skip
            print(json.dumps(rows[-1]), flush=True)
    return rows


def _wait_for_coefficients(channel: Any) -> None:
    """Wait for the first message with coefficients."""
    end_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < end_s:
        sample = channel.try_recv()
        if sample is None:
            time.sleep(0.05)
        elif str(sample.key_expr).endswith("/coefficients"):
            return
    raise SystemExit("no coefficients came")


def _loopback_bytes() -> int:
    """Return the number of bytes sent over ``lo``."""
    line = next(
        line for line in Path("/proc/net/dev").read_text("ascii").splitlines() if line.strip().startswith("lo:")
    )
    return int(line.split(":")[1].split()[8])


def _restart_in_namespace() -> None:
    """Restart the program in a separate network namespace, if this is permitted."""
    if (
        os.environ.get(NAMESPACE_VARIABLE) is not None
        or os.geteuid() != 0
        or not shutil.which("unshare")
        or not shutil.which("ip")
    ):
        return
    again = [sys.executable, "-m", "tests.experiments.benchmarks.fleet", *sys.argv[1:]]
    line = 'ip link set lo up && exec "$@"'
    os.environ[NAMESPACE_VARIABLE] = "1"
    os.execvp("unshare", ["unshare", "--net", "--", "sh", "-c", line, "sh", *again])


def main() -> None:
    """Measure and print the results as JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--daemons", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--rate", type=float, default=10.0)
    parser.add_argument("--publish", default="1 Hz")
    parser.add_argument("--settings", action="store_true")
    parser.add_argument("--router", nargs="+", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.router:
        run_router(*arguments.router)
        return
    _restart_in_namespace()
    if arguments.settings:
        measure_settings(arguments.seconds)
    else:
        print(json.dumps(run_fleet(arguments.daemons, arguments.rate, arguments.publish, arguments.seconds), indent=1))


if __name__ == "__main__":
    main()
