"""Test of a noise coefficient above a limit: event, hook command, zenoh message, status and metrics."""

import json
import re
import sys
import urllib.request
from pathlib import Path

import pytest

pytest.importorskip("prometheus_client", reason="prometheus-client is not installed")

from monitor.daemon.service import Service
from tests.support.paced_sensor import follow_reader
from tests.support.ports import free_endpoint, free_port
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.zenoh_sessions import open_session
from tests.system.rig import RecordingOutput, run_service

RATE_HZ = 100.0
AT_S = 60.0
CONFIG = """
[[device]]
name = "bench"
rate = 100.0
window = 60.0
model = "consumer-mems"
[[device.limit]]
axes = "*"
letter = "N"
times_model = 1.5
hold = "5s"
[device.driver]
link = "virtual"
model = "consumer-mems"
speed = 30.0
effect = ["gz.angle_random_walk:N=6e-4"]
effect_at = {at_s}
[[hook]]
on = ["limit_crossed"]
command = ["./hook", "{out}"]
key = "site/alarms"
[zenoh]
listen = ["{endpoint}"]
[viewer]
mode = "none"
[metrics]
listen = "127.0.0.1:{port}"
"""
HOOK = """
import os, sys
open(sys.argv[1] + ".part", "w").write(sys.stdin.read())
os.rename(sys.argv[1] + ".part", sys.argv[1])
"""


def pace(service: Service) -> None:
    follow_reader(service.workers[0].simulated, service.workers[0].driver)


def test_crossed_limit_is_passed_to_hook_command_and_zenoh_key(tmp_path: Path) -> None:
    hook, out, endpoint = tmp_path / "hook", tmp_path / "event.json", free_endpoint()
    hook.write_text(f"#!{sys.executable} -S\n{HOOK}")
    hook.chmod(0o755)
    config = CONFIG.format(at_s=AT_S, out=out, endpoint=endpoint, port=(port := free_port()))
    with run_service(tmp_path, config, output := RecordingOutput(), pace) as run:
        wait_for(lambda: run.service.zenoh.state == "ok", "zenoh")
        with open_session(connect=[endpoint]) as listener:
            messages = []
            listener.declare_subscriber("site/**", lambda sample: messages.append(bytes(sample.payload)))
            wait_for(out.exists, "the hook")
            wait_for(lambda: bool(messages), "the message")
        wait_for(lambda: output.healths["bench"].crossed == ("gz N",), "the status")
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=PATIENCE_S) as response:
            numbers = response.read().decode()
    assert (output.healths["bench"].outputs["hook"], output.healths["bench"].outputs["metrics"]) == ("ok", "ok")
    assert 'imu_monitor_limits_crossed{device="bench"} 1.0' in numbers
    assert re.search(r'imu_monitor_coefficient_lo\{axis="gz",device="bench",letter="N"\} \d', numbers)
    crossed = [event for _, event in output.events if event.kind == "limit_crossed"]
    assert [event.axis for event in crossed] == ["gz"]
    event = json.loads(out.read_text())
    assert event == json.loads(messages[0])
    assert (event["device"], event["kind"], event["axis"], event["text"]) == (
        "bench",
        "limit_crossed",
        "gz",
        crossed[0].text,
    )
    assert event["what"]["N"]["lo"] > event["what"]["N"]["limit"] == 1.5 * 1.5e-4
    assert (output.healths["bench"].lost, output.healths["bench"].bad) == (0, 0)
    assert event["samples"] >= (AT_S + 5.0) * RATE_HZ
