"""A sensor's noise rises past the user's limit: an event, a command that is handed it, a message on the user's key."""

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
from tests.support.zenoh_sessions import session
from tests.system.rig import Caught, running

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
command = ["./tell", "{out}"]
key = "site/alarms"
[zenoh]
listen = ["{endpoint}"]
[viewer]
mode = "none"
[metrics]
listen = "127.0.0.1:{port}"
"""
TELL = """
import os, sys
open(sys.argv[1] + ".part", "w").write(sys.stdin.read())
os.rename(sys.argv[1] + ".part", sys.argv[1])
"""


def pace(service: Service) -> None:
    follow_reader(service.workers[0].simulated, service.workers[0].driver)


def test_noise_that_rises_past_a_limit_is_told_to_the_users_program(tmp_path: Path) -> None:
    tell, out, endpoint = tmp_path / "tell", tmp_path / "event.json", free_endpoint()
    tell.write_text(f"#!{sys.executable} -S\n{TELL}")
    tell.chmod(0o755)
    config = CONFIG.format(at_s=AT_S, out=out, endpoint=endpoint, port=(port := free_port()))
    with running(tmp_path, config, caught := Caught(), pace) as service:
        wait_for(lambda: service.service.zenoh.state == "ok", "zenoh")
        with session(connect=[endpoint]) as listener:
            heard = []
            listener.declare_subscriber("site/**", lambda sample: heard.append(bytes(sample.payload)))
            wait_for(out.exists, "the hook")
            wait_for(lambda: bool(heard), "the message")
        wait_for(lambda: caught.healths["bench"].crossed == ("gz N",), "the status")
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=PATIENCE_S) as answer:
            numbers = answer.read().decode()
    assert (caught.healths["bench"].outputs["hook"], caught.healths["bench"].outputs["metrics"]) == ("ok", "ok")
    assert 'imu_monitor_limits_crossed{device="bench"} 1.0' in numbers
    assert re.search(r'imu_monitor_coefficient_lo\{axis="gz",device="bench",letter="N"\} \d', numbers)
    crossed = [event for _, event in caught.events if event.kind == "limit_crossed"]
    assert [event.axis for event in crossed] == ["gz"]
    told = json.loads(out.read_text())
    assert told == json.loads(heard[0])
    assert (told["device"], told["kind"], told["axis"], told["text"]) == (
        "bench",
        "limit_crossed",
        "gz",
        crossed[0].text,
    )
    assert told["what"]["N"]["lo"] > told["what"]["N"]["limit"] == 1.5 * 1.5e-4
    assert (caught.healths["bench"].lost, caught.healths["bench"].bad) == (0, 0)
    assert told["samples"] >= (AT_S + 5.0) * RATE_HZ
