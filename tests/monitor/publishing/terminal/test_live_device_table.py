"""Tests of the live device table at several widths, on terminals and in files, and with hostile messages."""

import io
import json
import re
import threading
import time
from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np
import pytest
from rich.cells import cell_len
from rich.console import Console

from drivers.data_types import Event
from drivers.errors import ConfigError
from monitor.common import topics
from monitor.common.unit_formatting import DEFAULT_UNITS, KINDS, UNIT_SYSTEMS, UnitSystem
from monitor.publishing import remote_device_states
from monitor.publishing.messages.results import CoefficientsMessage, EventMessage, ModelGapMessage, StatusMessage
from monitor.publishing.remote_device_states import MAX_EVENTS, RemoteDeviceRegistry
from monitor.publishing.terminal import live_device_table
from monitor.publishing.terminal.coefficient_tables import analysis_table
from monitor.publishing.terminal.watch import watch
from tests.monitor.publishing import example_results

NOW_S = 100.0


class SettableClock:
    def __init__(self) -> None:
        self.now_s = NOW_S

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> SettableClock:
    return SettableClock()


@pytest.fixture
def registry(clock: SettableClock) -> RemoteDeviceRegistry:
    return RemoteDeviceRegistry(clock)


def send_status(registry: RemoteDeviceRegistry, device: str, prefix: str = "imu", **changed: object) -> None:
    registry.process_message(
        topics.STATUS.key(prefix, device),
        StatusMessage.from_result(device, 1.76e9, 0, example_results.make_health(**changed)).encode(),
    )


def send_coefficients(registry: RemoteDeviceRegistry, device: str, seconds: float = 3600.0, scale: float = 1.0) -> None:
    estimate = example_results.make_estimate(seconds=seconds, scale=scale)
    registry.process_message(
        topics.COEFFICIENTS.key("imu", device), CoefficientsMessage.from_result(device, 1.76e9, 0, estimate).encode()
    )


def send_event(registry: RemoteDeviceRegistry, device: str, text: str) -> None:
    payload = EventMessage.from_result(device, 1.76e9, 1, Event("noise_changed", 0, text)).encode()
    registry.process_message(topics.EVENT.key("imu", device), payload)


def render_table(
    registry: RemoteDeviceRegistry,
    width: int = 120,
    now_s: float = NOW_S,
    height: int = 50,
    is_terminal: bool = False,
    units: UnitSystem = DEFAULT_UNITS,
) -> str:
    console = Console(width=width, height=height, file=io.StringIO(), force_terminal=is_terminal, record=True)
    console.print(live_device_table.device_overview(registry, now_s, units))
    return console.export_text()


def find_row(text: str, device: str) -> str:
    return next(line for line in text.splitlines() if line.startswith(f"{device} "))


def test_table_without_devices_shows_the_note(registry: RemoteDeviceRegistry) -> None:
    registry.note = "nobody at tcp/127.0.0.1:7450; trying again"
    assert (
        " ".join(render_table(registry).split()) == "imu-monitor 0 devices nobody at tcp/127.0.0.1:7450; trying again"
    )


def test_each_device_has_one_row_with_all_numbers(registry: RemoteDeviceRegistry) -> None:
    for device, scale in (("bench-1", 1.0), ("bench-2", 2.0)):
        send_status(registry, device)
        send_coefficients(registry, device, scale=scale)
    words = find_row(render_table(registry, 160, NOW_S + 0.4), "bench-1").split()
    assert words[:7] == ["bench-1", "●", "running", "99.98", "360,000", "3", "1"]
    # 1.5e-4 rad/√s · 180/π · 60 = 0.516 °/√h, within the interval of the estimate.
    values = [float(word) for word in words[7:16]]
    truth = [0.516, 0.696, 0.413, 8.25, 11.1, 6.60, 0.0288, 0.0486, 0.0360]
    assert values == pytest.approx(truth, rel=0.25)
    assert values[:3] == pytest.approx(truth[:3], rel=0.01)
    assert words[16:] == ["6.8", "0.4", "s"]


@pytest.mark.parametrize("width", [80, 100, 120, 160, 200])
def test_nothing_is_cut_off_at_usual_widths(registry: RemoteDeviceRegistry, width: int) -> None:
    for device in ("bench-1", "bench-2"):
        send_status(registry, device, received=28_812_345, lost=48_123)
        send_coefficients(registry, device)
    text = render_table(registry, width)
    lines = text.splitlines()
    assert max(cell_len(line) for line in lines) <= width
    assert "…" not in text
    assert all(head in text for head in ("N °/√h", "B °/h", "N m/s/√h", "received", "p99 ms"))
    assert ("0.515" in text) == (width != 100)  # at width 100, only two digits fit in a line


def test_60_columns_keep_all_labels(registry: RemoteDeviceRegistry) -> None:
    for device in ("bench-1", "bench-2"):
        send_status(registry, device)
        send_coefficients(registry, device)
    text = render_table(registry, 60)
    assert "…" not in text
    assert text.splitlines()[1].split() == ["device", "state", "Hz", "lost", "N", "°/√h", "B", "°/h", "N", "m/s/√h"]
    assert re.findall(r"\b[xyz]\b", text) == ["x", "y", "z"] * 2
    assert max(cell_len(line) for line in text.splitlines()) <= 60


@pytest.mark.parametrize("height", [50, 24, 16])
def test_chart_and_intervals_of_one_device_need_space(registry: RemoteDeviceRegistry, height: int) -> None:
    send_status(registry, "bench-1")
    send_coefficients(registry, "bench-1")
    registry.set_allan_curve("imu/bench-1", example_results.make_estimate().curve)
    text = render_table(registry, 100, height=height, is_terminal=True)
    assert len(text.splitlines()) < height
    assert ("Allan deviation, °/h" in text) == (height == 50)
    assert ("[95 % interval]" in text) == (height > 16)
    assert "K °/h/√h" in text


def test_last_table_states_the_running_time(registry: RemoteDeviceRegistry) -> None:
    send_status(registry, "bench-1")
    send_coefficients(registry, "bench-1")
    registry.set_allan_curve("imu/bench-1", example_results.make_estimate().curve)
    stream = io.StringIO()
    table = live_device_table.LiveTable(Console(file=stream, width=100), registry, begun_s=time.monotonic() - 75.0)
    registry.note = "viewer: http://127.0.0.1:9090"
    assert registry.note in render_table(registry, 100)
    text = table.render([], is_last=True)
    assert re.match(r"imu-monitor ran for [1-9] min \d+ s  1 device", text)
    assert registry.note not in text
    assert "Allan deviation, °/h" in text


def test_problem_of_a_running_device_is_yellow(registry: RemoteDeviceRegistry) -> None:
    send_status(registry, "bench-1", text="measured rate 99.3 Hz differs from the configured 200 Hz")
    console = Console(file=io.StringIO(), force_terminal=True, color_system="standard", width=100)
    with console.capture() as captured:
        console.print(live_device_table.device_overview(registry, NOW_S))
    assert "\x1b[33m! bench-1" in captured.get()


@pytest.mark.parametrize("units", UNIT_SYSTEMS)
def test_tables_of_all_units_fit_80_columns(registry: RemoteDeviceRegistry, units: str) -> None:
    """The coefficient tables contain the same numbers at 80 columns and at 200 columns, where nothing is cut off."""
    send_status(registry, "bench-1")
    send_coefficients(registry, "bench-1", seconds=600.0)
    narrow, wide = (
        render_table(registry, width, units=UNIT_SYSTEMS[units]).partition("bound;")[2] for width in (80, 200)
    )
    numbers = re.compile(r"\d[\d.e-]*")
    assert sorted(numbers.findall(narrow)) == sorted(numbers.findall(wide))
    for kind in KINDS:
        for column in UNIT_SYSTEMS[units].columns(kind):
            assert f"{column.symbol} {column.unit.name}" in narrow


def test_device_row_shows_the_noise_density_of_data_sheets(registry: RemoteDeviceRegistry) -> None:
    send_status(registry, "bench-1")
    send_coefficients(registry, "bench-1")
    found = [
        float(find_row(render_table(registry, 160, units=UNIT_SYSTEMS[name]), "bench-1").split()[7])
        for name in ("datasheet", "si")
    ]
    assert found == pytest.approx([1.5e-4 * np.sqrt(2.0) * np.degrees(1e3), 1.5e-4], rel=0.01)


def test_devices_have_one_line_each_from_100_columns(registry: RemoteDeviceRegistry) -> None:
    for device in ("a", "b", "c"):
        send_status(registry, device)
        send_coefficients(registry, device)
    assert [len(render_table(registry, width).splitlines()) for width in (79, 100, 160)] == [
        1 + 1 + 9,
        1 + 2 + 3,
        1 + 2 + 3,
    ]


def test_bounds_and_missing_values_are_marked(registry: RemoteDeviceRegistry) -> None:
    for device in ("early", "other"):
        send_status(registry, device)
    send_coefficients(registry, "early", seconds=100.0)
    assert find_row(render_table(registry, 160), "early").count("≤") == 3  # B of the three gyroscopes
    unknown = example_results.make_estimate()
    unknown.coefficients.status[:] = 0
    registry.process_message(
        "imu/early/coefficients", CoefficientsMessage.from_result("early", 1.0, 0, unknown).encode()
    )
    assert find_row(render_table(registry, 160), "early").count("—") == 9


def test_problems_come_first_with_a_sign_and_a_word(registry: RemoteDeviceRegistry) -> None:
    send_status(registry, "a-good")
    send_status(registry, "b-ended", state="ended")
    send_status(registry, "c-waiting", state="waiting", text="waiting for serial /dev/ttyUSB3", rate_hz=None)
    send_status(registry, "d-lost", state="lost", text="serial /dev/ttyUSB0: gone; trying again")
    send_status(registry, "e-stalled", outputs={"zenoh": "ok", "viewer": "stalled (12 dropped)"})
    text = render_table(registry)
    starts = [line.split()[:3] for line in text.splitlines()[2:7]]
    assert starts == [
        ["d-lost", "✖", "lost"],
        ["c-waiting", "◌", "waiting"],
        ["e-stalled", "●", "running"],
        ["a-good", "●", "running"],
        ["b-ended", "■", "ended"],
    ]
    assert "✖ d-lost  serial /dev/ttyUSB0: gone; trying again\n" in text
    assert "◌ c-waiting  waiting for serial /dev/ttyUSB3\n" in text
    assert "! e-stalled  viewer: stalled (12 dropped)\n" in text
    assert text.splitlines()[0].split("  ")[1:] == [
        "5 devices", "✖ 1 lost", "◌ 1 waiting", "● 2 running", "■ 1 ended"
    ]  # fmt: skip


def test_hostile_messages_need_bounded_memory(registry: RemoteDeviceRegistry) -> None:
    send_status(registry, "good")
    known = StatusMessage.from_result("good", 1.0, 0, example_results.make_health()).encode()
    deep = known[:-1] + b',"more":' + b"[" * 20_000 + b"]" * 20_000 + b"}"
    many_axes = (
        b'{"schema":"imu-monitor/coefficients/1","samples":1,"axes":{'
        + b",".join(b'"a%d":{}' % i for i in range(1_000_000))
        + b"}}"
    )
    for payload in (b"x" * 100_000, deep, known.replace(b'"received":', b'"received":1'.ljust(500, b"0") + b',"x":')):
        registry.process_message("imu/good/status", payload)
    registry.process_message("imu/good/coefficients", many_axes)
    assert registry.malformed == 4
    long = json.loads(known) | {"text": "x" * 60_000, "outputs": {f"o{i}": "y" * 500 for i in range(100)}}
    registry.process_message("imu/good/status", json.dumps(long).encode())
    stored_status = registry._devices["imu/good"].status
    assert stored_status is not None
    assert len(stored_status.text) + sum(len(a) + len(b) for a, b in stored_status.outputs.items()) < 10_000
    assert "good" in render_table(registry)


def test_excess_devices_are_ignored_until_others_have_been_silent_for_long(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(remote_device_states, "MAX_DEVICES", 3)
    clock = [0.0]
    registry = RemoteDeviceRegistry(lambda: clock[0])
    payload = StatusMessage.from_result("a", 1.0, 0, example_results.make_health()).encode()
    for device in ("a", "b", "c", "d", "x" * 300):
        registry.process_message(f"imu/{device}/status", payload)
        registry.set_liveliness_token(f"imu/{device}/alive", True)
    assert list(registry._devices) == ["imu/a", "imu/b", "imu/c"]
    assert registry.ignored == 4
    clock[0] = remote_device_states.FORGET_AFTER_S + 1.0
    registry.process_message("imu/a/status", payload)
    registry.process_message("imu/e/status", payload)
    assert sorted(registry._devices) == ["imu/a", "imu/c", "imu/e"]


def test_states_have_different_signs() -> None:
    signs = {state: sign for state, (sign, _) in live_device_table.STATES.items()}
    assert len({signs[state] for state in ("running", "waiting", "lost", "silent", "ended", "present")}) == 6


def test_removed_device_is_marked_as_gone(registry: RemoteDeviceRegistry, clock: SettableClock) -> None:
    send_status(registry, "a")
    registry.set_liveliness_token("imu/a/alive", True)
    registry.set_liveliness_token("imu/a/alive", False)
    assert find_row(render_table(registry, now_s=NOW_S + 3.0), "a").split()[1:3] == ["✖", "gone"]
    clock.now_s = NOW_S + 10.0
    registry.set_liveliness_token("imu/a/alive", True)
    send_status(registry, "a")
    assert find_row(render_table(registry, now_s=NOW_S + 10.5), "a").split()[1:3] == ["●", "running"]


@pytest.mark.parametrize("token_exists", [True, False])
def test_device_whose_daemon_has_ended_keeps_its_row_with_the_time(
    registry: RemoteDeviceRegistry, token_exists: bool
) -> None:
    for device in ("a", "b"):
        send_status(registry, device)
    registry.set_liveliness_token(topics.ALIVE.key("imu", "a"), token_exists)
    newest = datetime.now().astimezone()
    text = render_table(registry, now_s=NOW_S + 7200.0)
    assert find_row(text, "a")
    what = "no messages since" if token_exists else "the daemon has ended or cannot be reached since"
    times = [f"{newest - timedelta(hours=2, seconds=late):%H:%M:%S}" for late in range(-60, 2)]
    assert re.search(rf"a  {what} ({'|'.join(times)})\n", text)


def test_device_without_messages_is_shown_as_present(registry: RemoteDeviceRegistry) -> None:
    registry.set_liveliness_token("imu/new/alive", True)
    assert find_row(render_table(registry), "new").split()[:3] == ["new", "○", "present"]
    registry.set_liveliness_token("imu/other/status", True)
    assert "other" not in render_table(registry)


def test_devices_of_several_prefixes_show_their_full_key(registry: RemoteDeviceRegistry) -> None:
    send_status(registry, "a", prefix="lab")
    send_status(registry, "a", prefix="roof/north")
    text = render_table(registry)
    assert find_row(text, "lab/a")
    assert find_row(text, "roof/north/a")


def test_single_device_shows_every_coefficient_with_its_interval(registry: RemoteDeviceRegistry) -> None:
    send_status(registry, "a")
    send_coefficients(registry, "a", seconds=1000.0)
    text = render_table(registry, 140)
    assert "last 16 min 40 s; [95 % interval]; ≤ bound; — too few data yet" in text
    assert "Q µrad" in text
    assert "K µg/√h" in text
    gz = find_row(text, "gz")
    assert gz.count("[") == 3
    assert gz.count("≤") == gz.count("—") == 1
    low, high = (float(word) for word in gz.split("[")[2].split("]")[0].split(" … "))
    assert low < float(gz.split("[")[1].split()[-1]) < high
    narrow = render_table(registry, 80)
    assert "[" not in find_row(narrow, "gz")
    assert gz.split("[")[2].split("]")[0] in narrow.splitlines()[narrow.splitlines().index(find_row(narrow, "gz")) + 1]
    send_status(registry, "b")
    assert "95 % interval" not in render_table(registry, 140)


def test_ambiguous_k_and_r_are_marked() -> None:
    whole = example_results.make_estimate(seconds=1000.0)
    ambiguous = replace(whole, k_or_r=np.array([False, True, False, False, False, False]))
    console = Console(width=160, file=io.StringIO(), record=True)
    console.print(analysis_table(ambiguous))
    text = console.export_text()
    assert "; K or R: one of them\n" in text
    assert find_row(text, "gy").count("K or R") == 2
    assert "K or R" not in find_row(text, "gz")
    console.print(analysis_table(whole))
    assert "K or R" not in console.export_text()


def test_temperature_dependent_axes_are_marked() -> None:
    console = Console(width=160, file=io.StringIO(), record=True)
    console.print(analysis_table(example_results.make_estimate(seconds=1000.0), ("gy",)))
    text = console.export_text()
    assert "; † slow variance due to temperature\n" in text
    assert find_row(text, "gy").startswith("gy †")
    assert "†" not in find_row(text, "gz")
    console.print(analysis_table(example_results.make_estimate(seconds=1000.0)))
    assert "†" not in console.export_text()


def test_gyroscope_alone_has_no_accelerometer_columns(registry: RemoteDeviceRegistry) -> None:
    whole = example_results.make_estimate()
    whole.curve.avar[:, 3:] = float("nan")
    send_status(registry, "a")
    registry.process_message("imu/a/coefficients", CoefficientsMessage.from_result("a", 1.0, 0, whole).encode())
    text = render_table(registry, 160)
    assert "°/√h" in text
    assert "m/s/√h" not in text
    assert "Accelerometers" not in text


def test_last_events_are_shown(registry: RemoteDeviceRegistry) -> None:
    for i in range(9):
        send_event(registry, "a", f"event {i}")
    lines = render_table(registry).splitlines()[-MAX_EVENTS:]
    assert [line.split("  ")[1:] for line in lines] == [["a", f"event {i}"] for i in range(4, 9)]
    assert all(len(line.split("  ")[0]) == 8 for line in lines)


def test_invalid_time_of_an_event_is_shown_in_seconds(registry: RemoteDeviceRegistry) -> None:
    payload = EventMessage.from_result("a", 1e300, 1, Event("moved", 0, "moved")).encode()
    registry.process_message("imu/a/event", payload)
    assert "1e+300 s  a  moved" in render_table(registry)


def test_malformed_messages_are_counted_and_change_nothing(registry: RemoteDeviceRegistry) -> None:
    send_status(registry, "a")
    before = render_table(registry)
    for topic in (topics.STATUS, topics.COEFFICIENTS, topics.GAP, topics.EVENT):
        for payload in (b"", b"{", b"null", b'{"schema":"imu-monitor/status/9"}', b"\xff"):
            registry.process_message(topic.key("imu", "a"), payload)
            registry.process_message(topic.key("imu", "nobody"), payload)
    registry.process_message("imu/a/samples", b"not read")
    registry.process_message("imu/a/mood", b"not known")
    assert registry.malformed == 40
    after = render_table(registry)
    assert after.replace("  40 malformed messages", "") == before


def test_received_texts_cannot_control_the_terminal(registry: RemoteDeviceRegistry) -> None:
    control_codes = "\x1b[2J\x1b]0;owned\x07[red]x[/red]\r\n\x9b31m"
    send_status(
        registry,
        "a" + control_codes.replace("\n", ""),
        state=control_codes,
        text=control_codes,
        outputs={control_codes: control_codes},
    )
    send_event(registry, "a", control_codes)
    console = Console(width=200, file=io.StringIO(), force_terminal=False)
    console.print(live_device_table.device_overview(registry, NOW_S))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "[red]x[/red]" in text
    assert all(character.isprintable() or character == "\n" for character in text)


def test_table_is_limited_to_the_height_of_the_terminal(registry: RemoteDeviceRegistry) -> None:
    for i in range(100):
        send_status(registry, f"device-{i:03}")
    send_status(registry, "zz", state="lost")
    text = render_table(registry, 120, height=40, is_terminal=True)
    lines = text.splitlines()
    assert len(lines) < 40
    assert lines[2].startswith("zz")
    rows = sum(line.startswith(("device-", "zz")) for line in lines)
    assert f"… and {101 - rows} more with fewer problems" in text
    assert render_table(registry, 120).count("device-") == 100  # a file has no height limit


def test_table_can_be_rendered_while_messages_arrive(registry: RemoteDeviceRegistry) -> None:
    def send_many_statuses() -> None:
        for i in range(300):
            send_status(registry, f"d{i}")
            registry.set_liveliness_token(f"imu/d{i}/alive", True)

    sender = threading.Thread(target=send_many_statuses)
    sender.start()
    while sender.is_alive():
        render_table(registry)
    sender.join()
    assert "300 devices" in render_table(registry)


def test_watch_refuses_invalid_arguments() -> None:
    console = Console(file=io.StringIO())
    with pytest.raises(ConfigError, match=r'key expression "imu/\*\*\*"'):
        watch("imu/***", console=console, once_s=0.0)
    with pytest.raises(ConfigError, match='connect "nowhere"'):
        watch(connect=["nowhere"], console=console, once_s=0.0)


def test_disagreement_with_the_model_is_shown(registry: RemoteDeviceRegistry) -> None:
    send_status(registry, "a")
    registry.process_message(
        "imu/a/gap",
        ModelGapMessage.from_result("a", 1.0, 0, example_results.make_comparison(scale=1.2, gz=False)).encode(),
    )
    assert "gz disagrees with its model: " in render_table(registry, 160)
    registry.process_message(
        "imu/a/gap", ModelGapMessage.from_result("a", 1.0, 0, example_results.make_comparison(gz=True)).encode()
    )
    assert "disagrees" not in render_table(registry, 160)
