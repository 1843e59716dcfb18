"""The table as it is read: at several widths, with and without a terminal, of good and of malicious messages."""

import io
import json
import threading
from dataclasses import replace

import numpy as np
import pytest
from rich.cells import cell_len
from rich.console import Console

from drivers.data_types import Event
from drivers.errors import ConfigError
from monitor.common import topics
from monitor.publishing import remote_device_states
from monitor.publishing.messages.results import CoefficientsMessage, EventMessage, ModelGapMessage, StatusMessage
from monitor.publishing.remote_device_states import MAX_EVENTS, RemoteDeviceRegistry
from monitor.publishing.terminal import live_device_table
from monitor.publishing.terminal.coefficient_tables import analysis_table
from monitor.publishing.terminal.watch import watch
from tests.monitor.publishing import made

NOW_S = 100.0


class Clock:
    def __init__(self) -> None:
        self.now_s = NOW_S

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def board(clock: Clock) -> RemoteDeviceRegistry:
    return RemoteDeviceRegistry(clock)


def status(board: RemoteDeviceRegistry, device: str, prefix: str = "imu", **changed: object) -> None:
    board.process_message(
        topics.STATUS.key(prefix, device), StatusMessage.from_result(device, 1.76e9, 0, made.health(**changed)).encode()
    )


def noise(board: RemoteDeviceRegistry, device: str, seconds: float = 3600.0, scale: float = 1.0) -> None:
    estimate = made.estimate(seconds=seconds, scale=scale)
    board.process_message(
        topics.COEFFICIENTS.key("imu", device), CoefficientsMessage.from_result(device, 1.76e9, 0, estimate).encode()
    )


def event(board: RemoteDeviceRegistry, device: str, text: str) -> None:
    payload = EventMessage.from_result(device, 1.76e9, 1, Event("noise_changed", 0, text)).encode()
    board.process_message(topics.EVENT.key("imu", device), payload)


def shown(
    board: RemoteDeviceRegistry, width: int = 120, now_s: float = NOW_S, height: int = 50, is_terminal: bool = False
) -> str:
    console = Console(width=width, height=height, file=io.StringIO(), force_terminal=is_terminal, record=True)
    console.print(live_device_table.device_overview(board, now_s))
    return console.export_text()


def row(text: str, device: str) -> str:
    return next(line for line in text.splitlines() if line.startswith(f"{device} "))


def test_nothing_heard_yet(board: RemoteDeviceRegistry) -> None:
    board.note = "nobody at tcp/127.0.0.1:7450; trying again"
    assert " ".join(shown(board).split()) == "imu-monitor 0 devices nobody at tcp/127.0.0.1:7450; trying again"


def test_one_row_a_device_with_all_its_numbers(board: RemoteDeviceRegistry) -> None:
    for device, scale in (("bench-1", 1.0), ("bench-2", 2.0)):
        status(board, device)
        noise(board, device, scale=scale)
    words = row(shown(board, 160, NOW_S + 0.4), "bench-1").split()
    assert words[:7] == ["bench-1", "●", "running", "99.98", "360,000", "3", "1"]
    # made.fitted of 1.5e-4 rad/√s · 180/π · 60 = 0.516 °/√h and so on, within its interval
    values = [float(word) for word in words[7:16]]
    truth = [0.516, 0.696, 0.413, 8.25, 11.1, 6.60, 0.0288, 0.0486, 0.0360]
    assert values == pytest.approx(truth, rel=0.25)
    assert values[:3] == pytest.approx(truth[:3], rel=0.01)
    assert words[16:] == ["6.8", "0.4", "s"]


@pytest.mark.parametrize("width", [80, 100, 120, 160, 200])
def test_nothing_is_cut_off_at_any_usual_width(board: RemoteDeviceRegistry, width: int) -> None:
    for device in ("bench-1", "bench-2"):
        status(board, device, received=28_812_345, lost=48_123)
        noise(board, device)
    text = shown(board, width)
    lines = text.splitlines()
    assert max(cell_len(line) for line in lines) <= width
    assert "…" not in text
    assert all(head in text for head in ("N °/√h", "B °/h", "N m/s/√h", "received", "p99 ms"))
    assert ("0.515" in text) == (width != 100)  # two digits where three do not fit in a line


def test_a_line_a_device_from_100_columns_on(board: RemoteDeviceRegistry) -> None:
    for device in ("a", "b", "c"):
        status(board, device)
        noise(board, device)
    assert [len(shown(board, width).splitlines()) for width in (79, 100, 160)] == [1 + 1 + 9, 1 + 2 + 3, 1 + 2 + 3]


def test_bounds_and_too_few_data_are_marked(board: RemoteDeviceRegistry) -> None:
    for device in ("early", "other"):
        status(board, device)
    noise(board, "early", seconds=100.0)
    assert row(shown(board, 160), "early").count("≤") == 3  # B of the gyroscopes
    unknown = made.estimate()
    unknown.coefficients.status[:] = 0
    board.process_message("imu/early/coefficients", CoefficientsMessage.from_result("early", 1.0, 0, unknown).encode())
    assert row(shown(board, 160), "early").count("—") == 9


def test_trouble_comes_first_and_has_a_sign_and_a_word(board: RemoteDeviceRegistry) -> None:
    status(board, "a-good")
    status(board, "b-ended", state="ended")
    status(board, "c-waiting", state="waiting", text="waiting for serial /dev/ttyUSB3", rate_hz=None)
    status(board, "d-lost", state="lost", text="serial /dev/ttyUSB0: gone; trying again")
    status(board, "e-stalled", outputs={"zenoh": "ok", "viewer": "stalled (12 dropped)"})
    text = shown(board)
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


def test_hostile_messages_leave_a_bounded_board(board: RemoteDeviceRegistry) -> None:
    status(board, "good")
    known = StatusMessage.from_result("good", 1.0, 0, made.health()).encode()
    deep = known[:-1] + b',"more":' + b"[" * 20_000 + b"]" * 20_000 + b"}"
    many_axes = (
        b'{"schema":"imu-monitor/coefficients/1","samples":1,"axes":{'
        + b",".join(b'"a%d":{}' % i for i in range(1_000_000))
        + b"}}"
    )
    for payload in (b"x" * 100_000, deep, known.replace(b'"received":', b'"received":1'.ljust(500, b"0") + b',"x":')):
        board.process_message("imu/good/status", payload)
    board.process_message("imu/good/coefficients", many_axes)
    assert board.malformed == 4
    long = json.loads(known) | {"text": "x" * 60_000, "outputs": {f"o{i}": "y" * 500 for i in range(100)}}
    board.process_message("imu/good/status", json.dumps(long).encode())
    held = board._devices["imu/good"].status
    assert held is not None
    assert len(held.text) + sum(len(a) + len(b) for a, b in held.outputs.items()) < 10_000
    assert "good" in shown(board)


def test_devices_beyond_the_bound_are_passed_over_until_others_have_been_silent_for_long(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(remote_device_states, "MAX_DEVICES", 3)
    clock = [0.0]
    board = RemoteDeviceRegistry(lambda: clock[0])
    payload = StatusMessage.from_result("a", 1.0, 0, made.health()).encode()
    for device in ("a", "b", "c", "d", "x" * 300):
        board.process_message(f"imu/{device}/status", payload)
        board.set_liveliness_token(f"imu/{device}/alive", True)
    assert list(board._devices) == ["imu/a", "imu/b", "imu/c"]
    assert board.ignored == 4
    clock[0] = remote_device_states.FORGET_AFTER_S + 1.0
    board.process_message("imu/a/status", payload)
    board.process_message("imu/e/status", payload)
    assert sorted(board._devices) == ["imu/a", "imu/c", "imu/e"]


def test_states_have_different_signs_for_different_ranks() -> None:
    signs = {state: sign for state, (sign, _) in live_device_table.STATES.items()}
    assert len({signs[state] for state in ("running", "waiting", "lost", "silent", "ended", "present")}) == 6


def test_a_device_that_goes_is_marked(board: RemoteDeviceRegistry, clock: Clock) -> None:
    status(board, "a")
    board.set_liveliness_token("imu/a/alive", True)
    board.set_liveliness_token("imu/a/alive", False)
    assert row(shown(board, now_s=NOW_S + 3.0), "a").split()[1:3] == ["✖", "gone"]
    clock.now_s = NOW_S + 10.0
    board.set_liveliness_token("imu/a/alive", True)
    status(board, "a")
    assert row(shown(board, now_s=NOW_S + 10.5), "a").split()[1:3] == ["●", "running"]


def test_a_device_of_which_only_the_presence_is_known(board: RemoteDeviceRegistry) -> None:
    board.set_liveliness_token("imu/new/alive", True)
    assert row(shown(board), "new").split()[:3] == ["new", "○", "present"]
    board.set_liveliness_token("imu/other/status", True)
    assert "other" not in shown(board)


def test_devices_of_several_prefixes_show_their_whole_key(board: RemoteDeviceRegistry) -> None:
    status(board, "a", prefix="lab")
    status(board, "a", prefix="roof/north")
    text = shown(board)
    assert row(text, "lab/a")
    assert row(text, "roof/north/a")


def test_one_device_alone_shows_every_coefficient_with_its_interval(board: RemoteDeviceRegistry) -> None:
    status(board, "a")
    noise(board, "a", seconds=1000.0)
    text = shown(board, 140)
    assert "last 16 min 40 s; [95 % interval]; ≤ bound; — too few data yet" in text
    assert "Q µrad" in text
    assert "K µg/√h" in text
    gz = row(text, "gz")
    assert gz.count("[") == 3
    assert gz.count("≤") == gz.count("—") == 1
    low, high = (float(word) for word in gz.split("[")[2].split("]")[0].split(" … "))
    assert low < float(gz.split("[")[1].split()[-1]) < high
    narrow = shown(board, 80)
    assert "[" not in row(narrow, "gz")
    assert gz.split("[")[2].split("]")[0] in narrow.splitlines()[narrow.splitlines().index(row(narrow, "gz")) + 1]
    status(board, "b")
    assert "95 % interval" not in shown(board, 140)


def test_k_or_r_is_marked_on_the_axes_that_have_it() -> None:
    whole = made.estimate(seconds=1000.0)
    either = replace(whole, k_or_r=np.array([False, True, False, False, False, False]))
    console = Console(width=160, file=io.StringIO(), record=True)
    console.print(analysis_table(either))
    text = console.export_text()
    assert "; K or R: one of them\n" in text
    assert row(text, "gy").count("K or R") == 2
    assert "K or R" not in row(text, "gz")
    console.print(analysis_table(whole))
    assert "K or R" not in console.export_text()


def test_axes_whose_slow_part_is_temperature_are_marked() -> None:
    console = Console(width=160, file=io.StringIO(), record=True)
    console.print(analysis_table(made.estimate(seconds=1000.0), ("gy",)))
    text = console.export_text()
    assert "; † slow variance due to temperature\n" in text
    assert row(text, "gy").startswith("gy †")
    assert "†" not in row(text, "gz")
    console.print(analysis_table(made.estimate(seconds=1000.0)))
    assert "†" not in console.export_text()


def test_a_gyroscope_alone_has_no_accelerometer_columns(board: RemoteDeviceRegistry) -> None:
    whole = made.estimate()
    whole.curve.avar[:, 3:] = float("nan")
    status(board, "a")
    board.process_message("imu/a/coefficients", CoefficientsMessage.from_result("a", 1.0, 0, whole).encode())
    text = shown(board, 160)
    assert "°/√h" in text
    assert "m/s/√h" not in text
    assert "Accelerometers" not in text


def test_the_last_events(board: RemoteDeviceRegistry) -> None:
    for i in range(9):
        event(board, "a", f"event {i}")
    lines = shown(board).splitlines()[-MAX_EVENTS:]
    assert [line.split("  ")[1:] for line in lines] == [["a", f"event {i}"] for i in range(4, 9)]
    assert all(len(line.split("  ")[0]) == 8 for line in lines)


def test_a_time_that_is_no_date(board: RemoteDeviceRegistry) -> None:
    payload = EventMessage.from_result("a", 1e300, 1, Event("moved", 0, "moved")).encode()
    board.process_message("imu/a/event", payload)
    assert "1e+300 s  a  moved" in shown(board)


def test_malformed_messages_are_counted_and_change_nothing(board: RemoteDeviceRegistry) -> None:
    status(board, "a")
    before = shown(board)
    for topic in (topics.STATUS, topics.COEFFICIENTS, topics.GAP, topics.EVENT):
        for payload in (b"", b"{", b"null", b'{"schema":"imu-monitor/status/9"}', b"\xff"):
            board.process_message(topic.key("imu", "a"), payload)
            board.process_message(topic.key("imu", "nobody"), payload)
    board.process_message("imu/a/samples", b"not read")
    board.process_message("imu/a/mood", b"not known")
    assert board.malformed == 40
    after = shown(board)
    assert after.replace("  40 malformed messages", "") == before


def test_a_sender_cannot_steer_the_terminal(board: RemoteDeviceRegistry) -> None:
    evil = "\x1b[2J\x1b]0;owned\x07[red]x[/red]\r\n\x9b31m"
    status(board, "a" + evil.replace("\n", ""), state=evil, text=evil, outputs={evil: evil})
    event(board, "a", evil)
    console = Console(width=200, file=io.StringIO(), force_terminal=False)
    console.print(live_device_table.device_overview(board, NOW_S))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "[red]x[/red]" in text
    assert all(character.isprintable() or character == "\n" for character in text)


def test_more_devices_than_lines(board: RemoteDeviceRegistry) -> None:
    for i in range(100):
        status(board, f"device-{i:03}")
    status(board, "zz", state="lost")
    text = shown(board, 120, height=40, is_terminal=True)
    lines = text.splitlines()
    assert len(lines) < 40
    assert lines[2].startswith("zz")
    rows = sum(line.startswith(("device-", "zz")) for line in lines)
    assert f"… and {101 - rows} more with fewer problems" in text
    assert shown(board, 120).count("device-") == 100  # a file takes them all


def test_two_threads_at_once(board: RemoteDeviceRegistry) -> None:
    def feed() -> None:
        for i in range(300):
            status(board, f"d{i}")
            board.set_liveliness_token(f"imu/d{i}/alive", True)

    feeder = threading.Thread(target=feed)
    feeder.start()
    while feeder.is_alive():
        shown(board)
    feeder.join()
    assert "300 devices" in shown(board)


def test_watch_refuses_what_zenoh_refuses() -> None:
    console = Console(file=io.StringIO())
    with pytest.raises(ConfigError, match=r'key expression "imu/\*\*\*"'):
        watch("imu/***", console=console, once_s=0.0)
    with pytest.raises(ConfigError, match='connect "nowhere"'):
        watch(connect=["nowhere"], console=console, once_s=0.0)


def test_a_device_that_disagrees_with_its_model_says_so(board: RemoteDeviceRegistry) -> None:
    status(board, "a")
    board.process_message(
        "imu/a/gap", ModelGapMessage.from_result("a", 1.0, 0, made.look(scale=1.2, gz=False)).encode()
    )
    assert "gz disagrees with its model: " in shown(board, 160)
    board.process_message("imu/a/gap", ModelGapMessage.from_result("a", 1.0, 0, made.look(gz=True)).encode())
    assert "disagrees" not in shown(board, 160)
