"""Tests of hooks, which run commands with an event on standard input and limit their number and time."""

import json
import os
import sys
import threading
from functools import partial
from pathlib import Path

import pytest

from drivers.data_types import Event
from drivers.secret_masking import remember_secrets_of_process
from monitor.daemon.operations.hooks import BURST, MAX_QUEUED, RUN_INTERVAL_S, THREADS, Hooks
from monitor.settings.loading import Hook
from tests.support.waiting import FOREVER_S, PATIENCE_S, wait_for

EVENT = Event("limit_crossed", 2_000_000_000, "gz $(touch no) `touch no` ; touch no", "gz", {}, 1_000_000_000, 5.0)


def write_program(folder: Path, text: str, name: str = "tell") -> str:
    """Write an executable Python program."""
    path = folder / name
    path.write_text(f"#!{sys.executable} -S\nimport json, os, sys, time\n{text}\n")
    path.chmod(0o755)
    return str(path)


def make_hook(
    *command: str, timeout_s: float = PATIENCE_S, on: str = "*", devices: tuple[str, ...] = (), key: str = ""
) -> Hook:
    return Hook.model_construct(
        on=frozenset({on}), devices=frozenset(devices), command=command, key=key or None, timeout_s=timeout_s
    )


class RunningHooks:
    """Hooks that are closed at the end of the test."""

    def __init__(self, *hooks: Hook) -> None:
        self.sent: list[tuple[str, bytes]] = []
        self.now_s = 0.0
        self.hooks = Hooks(hooks, self.publish, lambda: self.now_s)

    def publish(self, key: str, payload: bytes) -> str:
        self.sent.append((key, payload))
        return ""

    def __enter__(self) -> "RunningHooks":
        return self

    def __exit__(self, *_: object) -> None:
        self.hooks.close()

    def raise_event(self, event: Event = EVENT, device: str = "d") -> None:
        self.hooks.publish_event(device, 1.76e9, 7, event)


def test_command_receives_the_event_and_its_text_is_not_executed(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    write = (
        "names = ('DEVICE', 'KIND', 'AXIS')\n"
        "received = [sys.argv[1:], json.load(sys.stdin), [os.environ['IMU_MONITOR_' + name] for name in names]]\n"
        f"open({str(out)!r} + '.part', 'w').write(json.dumps(received))\n"
        f"os.rename({str(out)!r} + '.part', {str(out)!r})\n"
    )
    with RunningHooks(make_hook(write_program(tmp_path, write), "$HOME", "; rm -r x")) as running:
        running.raise_event()
        wait_for(out.exists)
    arguments, event, named = json.loads(out.read_text())
    assert arguments == ["$HOME", "; rm -r x"]
    assert (event["schema"], event["kind"], event["axis"]) == ("imu-monitor/event/1", "limit_crossed", "gz")
    assert (event["text"], event["t"], event["since"]) == (EVENT.text, 1.76e9, 1.76e9 - 1.0)
    assert named == ["d", "limit_crossed", "gz"]
    assert not (tmp_path / "no").exists()
    assert running.hooks.state == "ok"


def test_hook_runs_only_for_the_selected_kinds_and_devices() -> None:
    with RunningHooks(make_hook(on="link_lost", devices=("b",), key="site/alarms"), make_hook(key="all")) as running:
        running.raise_event()
        running.raise_event(Event("link_lost", 0, ""), "a")
        running.raise_event(Event("link_lost", 0, ""), "b")
    assert [key for key, _ in running.sent] == ["all", "all", "site/alarms", "all"]
    assert json.loads(running.sent[2][1])["device"] == "b"


def test_failed_command_is_reported_until_one_succeeds(tmp_path: Path) -> None:
    path = tmp_path / "fail"
    path.touch()
    text = f"print('first'); print('no modem\\x1b[31m')\nsys.exit(3 if os.path.exists({str(path)!r}) else 0)"
    with RunningHooks(make_hook(write_program(tmp_path, text))) as running:
        running.raise_event()
        wait_for(lambda: running.hooks.state != "ok")
        assert running.hooks.state == "tell: exit status 3: no modem�[31m (1 failed since the start)"
        path.unlink()
        running.raise_event()
        wait_for(lambda: running.hooks.state == "ok")


def test_secret_in_the_output_of_a_command_is_masked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MODEM_TOKEN", "Qx7-hunter2-Lm4")
    remember_secrets_of_process(os.environ, [])
    long_line = "print('x' * 300, 'password:', 'x' * 190 + 'a', os.environ['MODEM_TOKEN'])\nsys.exit(3)"
    with RunningHooks(make_hook(write_program(tmp_path, long_line))) as running:
        running.raise_event()
        wait_for(lambda: running.hooks.state != "ok")
        assert "exit status 3: " in running.hooks.state
        assert "hunter2" not in running.hooks.state
        assert "xxxxa" not in running.hooks.state  # the name of the password is cut off


def test_program_that_cannot_be_started_is_reported(tmp_path: Path) -> None:
    with RunningHooks(make_hook(str(tmp_path / "none"))) as running:
        running.raise_event()
        wait_for(lambda: "none: cannot be started: No such file" in running.hooks.state)


def test_command_beyond_its_time_limit_is_killed_with_its_children(tmp_path: Path) -> None:
    """The command does not read its input and prints without end."""
    child = tmp_path / "child"
    text = (
        "pid = os.fork()\n"
        f"if pid: open({str(child)!r}, 'w').write(str(pid))\n"
        "while True: os.write(1, b'x' * 1000); time.sleep(0.001)\n"
    )
    for timeout_s in (2.0, 8.0, 32.0):  # a loaded machine may need longer to start the command
        with RunningHooks(make_hook(write_program(tmp_path, text), timeout_s=timeout_s)) as running:
            running.raise_event()
            wait_for(lambda timeout_s=timeout_s: f"killed after {timeout_s:g} s" in running.hooks.state)
        if child.exists():
            break
    pid = int(child.read_text())
    wait_for(lambda: not is_running(pid))


ESCAPES = {
    "session": "if not os.fork(): os.setsid(); run()\ntime.sleep(1e6)",
    "session of an ended parent": "if not os.fork():\n os.setsid()\n if not os.fork(): run()\n os._exit(0)\n"
    "time.sleep(1e6)",
    "command that has ended": "if not os.fork(): os.setsid(); run()",
    "other environment": "if not os.fork(): os.setsid(); os.execve(sys.executable, [sys.executable, '-c', again], {})\n"
    "time.sleep(1e6)",
}  # fmt: skip


@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="needs /proc")
@pytest.mark.parametrize("escape", ESCAPES.values(), ids=ESCAPES)
@pytest.mark.parametrize("ending", ["time limit", "end of the service"])
def test_process_in_a_session_of_its_own_is_killed_with_the_command(tmp_path: Path, escape: str, ending: str) -> None:
    mark = tmp_path / "pid"
    again = f"import os, time; open({str(mark)!r}, 'w').write(str(os.getpid())); time.sleep(1e6)"
    text = f"import sys\nagain = {again!r}\ndef run():\n for fd in range(3): os.close(fd)\n exec(again)\n{escape}"
    for timeout_s in (2.0, 8.0, 32.0) if ending == "time limit" else (FOREVER_S,):
        running = RunningHooks(make_hook(write_program(tmp_path, text), timeout_s=timeout_s))
        running.raise_event()
        if ending == "time limit":
            wait_for(partial(says_killed, running, timeout_s))
        else:
            wait_for(lambda: mark.exists() and mark.read_text() != "")
        running.hooks.close()
        if mark.exists():
            break
    wait_for(lambda: not is_running(int(mark.read_text())))


def says_killed(running: RunningHooks, timeout_s: float) -> bool:
    return f"killed after {timeout_s:g} s" in running.hooks.state


def is_running(pid: int) -> bool:
    """Return True if the process runs; a zombie process does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_running_command_is_killed_when_the_service_ends(tmp_path: Path) -> None:
    mark = tmp_path / "pid"
    text = f"open({str(mark)!r}, 'w').write(str(os.getpid()))\ntime.sleep({FOREVER_S})"
    running = RunningHooks(make_hook(write_program(tmp_path, text), timeout_s=FOREVER_S))
    running.raise_event()
    wait_for(lambda: mark.exists() and mark.read_text() != "")
    running.hooks.close()  # returns, although the command would run on for a day
    wait_for(lambda: not is_running(int(mark.read_text())))
    assert not [t for t in threading.enumerate() if t.name.startswith("hooks")]


def test_flood_of_events_is_suppressed_but_a_rare_event_is_not() -> None:
    with RunningHooks(make_hook(key="site")) as running:
        for _ in range(1000):
            running.raise_event(Event("samples_lost", 0, "1 sample missing"))
        running.raise_event()
        assert len(running.sent) == BURST + 1
        assert json.loads(running.sent[-1][1])["kind"] == "limit_crossed"
        assert (
            running.hooks.state == f"ok, but {1000 - BURST} runs suppressed, because too many events occurred at once"
        )
        running.now_s = 2.5 * RUN_INTERVAL_S
        for _ in range(10):
            running.raise_event(Event("samples_lost", 0, "1 sample missing"))
        assert len(running.sent) == BURST + 1 + 2


def test_number_of_running_and_queued_commands_is_bounded(tmp_path: Path) -> None:
    marks = tmp_path / "marks"
    marks.mkdir()
    text = f"open(os.path.join({str(marks)!r}, str(os.getpid())), 'w')\ntime.sleep({FOREVER_S})"
    with RunningHooks(make_hook(write_program(tmp_path, text), timeout_s=FOREVER_S)) as running:
        for i in range(MAX_QUEUED + THREADS + 50):
            running.raise_event(device=f"d{i}")  # returns at once, although no command ends
        wait_for(lambda: len(os.listdir(marks)) == THREADS)
        assert "suppressed" in running.hooks.state
