"""Everything wrong with a file is told, each with its key and what would be right; what is shipped is right."""

import json
from pathlib import Path

import pytest

import drivers.decoders
import drivers.links
from drivers import module_lookup
from drivers.decoders.vectornav_ascii import VectornavAsciiDecoder
from drivers.driver import AxisMap
from drivers.errors import ConfigError
from monitor.common.shipped_config_paths import CONFIG_FOLDER, resolve_model_path
from monitor.estimation.allan.window import MAX_LENGTH, MIN_LENGTH
from monitor.settings.loading import (
    WINDOW_SAMPLES,
    VirtualTable,
    check_viewer_mode,
    examine_config_file,
    load_config,
    parse_duration_s,
    parse_rate_as_period,
)

DRIVER = 'driver = { link = "serial", port = "/dev/null", decoder = "vectornav_ascii" }'


def wrong(tmp_path, text):
    path = tmp_path / "my.toml"
    path.write_text(text, "utf-8")
    reading = examine_config_file(path)
    config, lines = reading.config, reading.wrong
    assert (config is None) == bool(lines)
    assert all(line.startswith(f"{path}: ") and "\n" not in line for line in lines)
    return [line.removeprefix(f"{path}: ") for line in lines]


def device(extra="", name="a", driver=DRIVER):
    return f'[[device]]\nname = "{name}"\n{extra}\n{driver}\n'


def test_a_device_needs_its_name_and_driver_only(tmp_path):
    path = tmp_path / "my.toml"
    path.write_text(device())
    (one,) = load_config(path).devices
    assert (one.name, one.rate_hz, one.window_s, one.tau) == ("a", None, 3600.0, "octave")
    assert (one.refit_s, one.publish_s, one.silence_s) == (0.1, 0.1, 3.0)
    assert one.axes == AxisMap()
    assert isinstance(one.decoder, VectornavAsciiDecoder)


LIMIT = "[[device.limit]]\n"
HOOK = "[[hook]]\n"
CASES = {
    "limit without a bound": (
        device() + LIMIT + 'axes = "gz"\nletter = "N"',
        ["device a: limit[0]: no bound; add above, below or times_model"],
    ),
    "limit of no axis": (
        device() + LIMIT + 'axes = "g"\nletter = "N"\nabove = 1.0',
        ['device a: limit[0].axes: "g"; possible are gx, gy, gz, g*, ax, ay, az, a*, *'],
    ),
    "limit of no letter": (
        device() + LIMIT + 'axes = "gz"\nletter = "X"\nabove = 1.0',
        ['device a: limit[0].letter: "X"; possible are Q, N, B, K, R'],
    ),
    "limit without a letter": (
        device() + LIMIT + 'axes = "gz"\nabove = 1.0',
        ["device a: limit[0].letter: missing"],
    ),
    "limit relative to nothing": (
        device() + LIMIT + 'axes = "gz"\nletter = "N"\ntimes_model = 1.5',
        ["device a: limit[0].times_model: the device has no model in force; add model"],
    ),
    "limit said twice": (
        device('model = "consumer-mems"') + LIMIT + 'axes = "gz"\nletter = "N"\ntimes_model = 1.5\nabove = 1.0',
        ["device a: limit[0]: above and times_model are the same bound; leave one out"],
    ),
    "limits that cross": (
        device() + LIMIT + 'axes = "gz"\nletter = "N"\nbelow = 2.0\nabove = 1.0',
        ["device a: limit[0]: below 2 must be less than above 1"],
    ),
    "limit held for nothing": (
        device() + LIMIT + 'axes = "gz"\nletter = "N"\nabove = 1.0\nhold = "often"',
        ['device a: limit[0].hold: "often" is not a duration'],
    ),
    "hook on nothing": (
        device() + HOOK + 'on = []\nkey = "x"',
        ['hook[0].on: empty; write kinds of events, or ["*"]'],
    ),
    "hook on what never happens": (
        device() + HOOK + 'on = ["limit_cross"]\nkey = "x"',
        ['hook[0].on[0]: "limit_cross"; possible are limit_crossed, limit_back, '],
    ),
    "hook of no device": (
        device() + HOOK + 'on = ["*"]\ndevices = ["b"]\nkey = "x"',
        ['hook[0].devices: "b"; possible are a'],
    ),
    "hook that does nothing": (device() + HOOK + 'on = ["*"]', ["hook[0]: nothing to do; add command or key"]),
    "hook by a name": (
        device() + HOOK + 'on = ["*"]\ncommand = ["mail"]',
        ['hook[0].command: "mail" is not a path; write the path of the program, e.g. "/usr/bin/mail"'],
    ),
    "hook that is not there": (device() + HOOK + 'on = ["*"]\ncommand = ["/none/x"]', ["/none/x: no such file"]),
    "hook that is no program": (
        device() + HOOK + f'on = ["*"]\ncommand = ["{CONFIG_FOLDER}/demo.toml"]',
        ["demo.toml: not executable; chmod +x it"],
    ),
    "hook on any key": (
        device() + HOOK + 'on = ["*"]\nkey = "site/*"',
        ["hook[0].key: expected a zenoh key such as"],
    ),
    "hook without zenoh": (
        device() + HOOK + 'on = ["*"]\nkey = "x"\n[zenoh]\nmode = "none"',
        ['hook[0].key: zenoh.mode is "none", so the message cannot be published'],
    ),
    "metrics nowhere": (
        device() + '[metrics]\nlisten = "9464"',
        ['metrics.listen: "9464" is not a host and port; write "127.0.0.1:9464"'],
    ),
    "unknown key": (device("windw = 60.0"), ['device a: windw: unknown key; did you mean "window"?']),
    "unknown table": ("[zenho]\n" + device(), ['zenho: unknown key; did you mean "zenoh"?']),
    "unknown key of zenoh": (
        device() + '[zenoh]\nlisten_to = ["x"]',
        ['zenoh.listen_to: unknown key; did you mean "listen"?'],
    ),
    "unknown key of the link": (
        device(driver='driver = { link = "serial", port = "x", baud = 1, decoder = "stim300" }'),
        ['device a: driver.baud: unknown key; did you mean "baudrate"?'],
    ),
    "unknown key of the decoder": (
        device(
            driver='driver = { link = "serial", port = "x", decoder = "stim300", decoder_options = { range = "5g" } }'
        ),
        ["device a: driver.decoder_options.range: unknown key"],
    ),
    "wrong type": (
        device('rate = "fast"'),
        ['device a: rate: expected a number from 0.001 Hz to 1 MHz, got "fast"'],
    ),
    "rate not above 0": (device("rate = 0"), ["device a: rate: 0 Hz is outside the supported range 0.001 Hz to 1 MHz"]),
    "rate not a number": (device("rate = nan"), ["device a: rate: nan Hz is outside the supported range"]),
    "rate without end": (device("rate = inf"), ["device a: rate: inf Hz is outside the supported range"]),
    "name missing": (f"[[device]]\n{DRIVER}", ["device[0].name: missing"]),
    "driver missing": ('[[device]]\nname = "a"', ["device a: driver: missing"]),
    "no device": ("", ["device: there is none"]),
    "two of one name": (device() + device(), ['2 devices are named "a"; names must be unique']),
    "impossible name": (device(name="a/b"), ['device[0].name: "a/b"; letters']),
    "no link": (device(driver='driver = { port = "x" }'), ["device a: driver.link: missing; possible are can, "]),
    "unknown link": (
        device(driver='driver = { link = "seral" }'),
        ['driver.link: "seral"; possible are serial, '],
    ),
    "loopback is no link of a file": (
        device(driver='driver = { link = "loopback" }'),
        ['link: "loopback"; possible'],
    ),
    "a link that is no word": (device(driver="driver = { link = 3 }"), ["driver.link: "]),
    "unknown protocol": (
        device(driver='driver = { link = "serial", port = "x", decoder = "stim30" }'),
        ['device a: driver.decoder: "stim30"; possible are stim300, '],
    ),
    "protocol missing": (
        device(driver='driver = { link = "serial", port = "x" }'),
        ["driver.decoder: missing; possible are dbc, "],
    ),
    "a protocol that is no word": (
        device(driver='driver = { link = "serial", port = "x", decoder = 3 }'),
        ["driver.decoder: "],
    ),
    "decoder that does not fit": (
        device(driver='driver = { link = "serial", port = "x", decoder = "ros2_imu" }'),
        ["device a: driver.decoder: ros2_imu reads messages, link serial provides bytes: possible are"],
    ),
    "options that are no table": (
        device(driver='driver = { link = "serial", port = "x", decoder = "text", decoder_options = 3 }'),
        ["driver.decoder_options: expected a table"],
    ),
    "bad unit": (
        device(
            driver='driver = { link = "serial", port = "x", decoder = "text", '
            'decoder_options = { columns = ["gx"], gyro_unit = "deg/h2" } }'
        ),
        ['driver.decoder_options.gyro_unit: "deg/h2" is not a unit of angular rate; possible are deg/h, deg/hr, '],
    ),
    "port missing": (
        device(driver='driver = { link = "serial", decoder = "stim300" }'),
        ["device a: driver.port: missing"],
    ),
    "window that is not a duration": (device('window = "1 week"'), ['device a: window: "1 week" is not a duration']),
    "window too short": (
        device("rate = 100\nwindow = 0.5"),
        ["50 samples; possible are 100 to 10000000: 1 to 100000 s"],
    ),
    "window too long": (device('rate = 1000\nwindow = "1d"'), ["86400000 samples"]),
    "window of nan": (device("window = nan"), ["window"]),
    "window without end": (device("window = inf"), ["window"]),
    "unknown tau": (
        device('tau = "octaves"'),
        ['tau: expected "octave", "decade10" or a list, got "octaves"'],
    ),
    "tau not above 0": (
        device("tau = [1.0, -1.0]"),
        ["device a: tau[1]: -1 s is outside the supported range 1 µs to 36525 d"],
    ),
    "impossible tau": (device("rate = 100\nwindow = 60\ntau = [100.0]"), ["device a: tau: none of [100.0] s lies"]),
    "no tau at all": (device("rate = 100\ntau = []"), ["device a: tau: "]),
    "refit": (device('refit = "often"'), ['device a: refit: "often" is not a rate; write "10 Hz" or "every sample"']),
    "publish": (
        device('publish = "0 Hz"'),
        ['device a: publish: "0 Hz" is not a rate; write "10 Hz" or "every block"'],
    ),
    "axes": (
        device('axes = { gx = "up" }'),
        ['device a: axes: gx = "up": expected two axes of the same kind out of gx gy gz ax ay az'],
    ),
    "a model that is not there": (
        device('model = "models/none.toml"'),
        ['device a: model: no model "models/none.toml"'],
    ),
    "silence below 0": (
        device(driver='driver = { link = "serial", port = "x", decoder = "stim300", silence = "3" }'),
        ['device a: driver.silence: expected a number from 1 ms to 36525 d, or 0, got "3"'],
    ),
    "a virtual speed without end": (
        device(driver='driver = { link = "virtual", speed = inf }'),
        ["device a: driver.speed: inf times is outside the supported range 0.001 to 10000 times"],
    ),
    "unknown virtual model": (device(driver='driver = { link = "virtual", model = "none" }'), ['no model "none"']),
    "unknown fault": (
        device(driver='driver = { link = "virtual", faults = { lots = 1 } }'),
        ['device a: driver.faults.lots: unknown key; did you mean "lost"?'],
    ),
    "more than all samples": (
        device(driver='driver = { link = "virtual", faults = { lost = 1.5 } }'),
        ["device a: driver.faults.lost: 1.5 is outside the supported range 0 to 1"],
    ),
    "more faults than samples": (
        device(driver='driver = { link = "virtual", faults = { lost = 0.6, cut = 0.6 } }'),
        ["device a: driver.faults: lost, repeated, flipped and cut are shares of all samples: their sum is at most 1"],
    ),
    "faults in a word": (
        device(driver='driver = { link = "virtual", faults = "some" }'),
        ['device a: driver.faults: expected a table, got "some"'],
    ),
    "replay of what cannot be": (
        device(driver='driver = { link = "replay", path = "a.jpg" }'),
        ["a.jpg: no such file"],
    ),
    "viewer": (
        device() + '[viewer]\nmode = "window"',
        ['viewer.mode: "window"; possible are none, web, auto, nat'],
    ),
    "viewer's port": (
        device() + "[viewer]\nport = 70000",
        ["viewer.port: 70000 is outside the supported range"],
    ),
    "viewer's history": (
        device() + '[viewer]\nhistory = "soon"',
        ['viewer.history: "soon" is not a duration'],
    ),
    "viewer's memory": (device() + "[viewer]\nmemory = 3", ["viewer.memory: expected text in quotes, got 3"]),
    "zenoh's mode": (device() + '[zenoh]\nmode = "pear"', ['zenoh.mode: "pear"; possible are peer, ']),
    "zenoh's prefix": (device() + '[zenoh]\nprefix = "a/*"', ["zenoh.prefix: "]),
    "log": (device() + '[log]\nlevel = "loud"', ['log.level: "loud"; possible are info, debug, error, warning']),
    "a device that is no table": ("device = 3", ["device: expected a list, got 3"]),
    "not TOML": ("[[device]\n", ["not TOML: "]),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_wrong_is_said(tmp_path, case):
    text, expected = CASES[case]
    lines = wrong(tmp_path, text)
    assert len(lines) == len(expected)
    for line, part in zip(lines, expected, strict=True):
        assert part in line


def test_a_signal_that_the_dbc_does_not_have(tmp_path):
    dbc = sorted((CONFIG_FOLDER / "dbc").glob("*.dbc"))[0]
    (line,) = wrong(
        tmp_path,
        device(
            driver=f'driver = {{ link = "can", channel = "vcan0", decoder = "dbc", '
            f'decoder_options = {{ file = "{dbc}", signals = {{ gz = "NoSuchSignal" }} }} }}'
        ),
    )
    assert line.startswith("device a: driver.decoder_options.signals.gz: ")
    assert "NoSuchSignal" in line


def test_a_file_that_is_no_recording(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"")
    (line,) = wrong(tmp_path, device(driver='driver = { link = "replay", path = "a.jpg" }'))
    assert "has no suffix of a file to replay" in line


def test_all_that_is_wrong_is_told_at_once(tmp_path):
    text = (
        device("rate = -1\nwindw = 3")
        + device('window = "soon"\nrefit = "x"\naxes = { gx = "q" }', "b", 'driver = { link = "serial", bautrate = 1 }')
        + '[log]\nlevel = "x"\n[viewer]\nmode = "y"\n'
    )
    lines = wrong(tmp_path, text)
    for part in (
        "rate",
        "windw",
        "window",
        "refit",
        "axes",
        "bautrate",
        "port: missing",
        "decoder: missing",
        "log",
        "viewer",
    ):
        assert any(part in line for line in lines), part
    with pytest.raises(ConfigError, match=rf"\(and {len(lines) - 1} more: imu-monitor check .*my.toml\)$"):
        load_config(tmp_path / "my.toml")


RIGHT = {
    "device": [
        {
            "name": "a",
            "rate": 100.0,
            "window": 60.0,
            "model": "consumer-mems",
            "driver": {
                "link": "serial",
                "port": "/dev/null",
                "decoder": "text",
                "decoder_options": {"columns": ["gx", "gy", "gz"]},
            },
            "axes": {},
            "limit": [{"axes": "gz", "letter": "N", "above": 1.0}],
        },
        {
            "name": "b",
            "driver": {
                "link": "can",
                "decoder_options": {"file": "j1939_imu", "signals": {"gz": "AngularRateInformation.YawRate"}},
            },
        },
        {"name": "c", "driver": {"link": "virtual", "faults": {}}},
        {"name": "d", "driver": {"link": "replay", "path": "a.csv"}},
        {"name": "e", "driver": {"link": "zenoh", "key": "imu/a/samples"}},
        {"name": "f", "driver": {"link": "serial", "port": "/dev/null", "decoder": "stim300", "decoder_options": {}}},
    ],
    "zenoh": {},
    "viewer": {},
    "storage": {},
    "hook": [{"on": ["*"], "key": "x"}],
    "metrics": {},
    "log": {},
}
MISTAKES = [
    (("zenho",), {}),
    (("device", 0, "windw"), 60),
    (("device", 0, "rate"), "fast"),
    (("device", 0, "refit"), "often"),
    (("device", 0, "publish"), "0 Hz"),
    (("device", 0, "tau"), [1.0, -1.0]),
    (("device", 0, "motion"), "tel"),
    (("device", 0, "restart"), 3),
    (("device", 0, "alarms_per_day"), -1),
    (("device", 0, "thermal_interval"), "often"),
    (("device", 0, "axes", "gx"), "up"),
    (("device", 0, "axes", "gy"), "ax"),
    (("device", 0, "driver", "baud"), 9600),
    (("device", 0, "driver", "baudrate"), 0),
    (("device", 0, "driver", "parity"), "X"),
    (("device", 0, "driver", "stopbits"), 3),
    (("device", 0, "driver", "read_timeout"), 9.0),
    (("device", 0, "driver", "silence"), "3"),
    (("device", 0, "driver", "decoder_options", "gyro_unit"), "LSB"),
    (("device", 0, "driver", "decoder_options", "accel_unit"), "counts"),
    (("device", 0, "driver", "decoder_options", "scale"), {"gw": 2.0}),
    (("device", 0, "driver", "decoder_options", "nmea"), "yes"),
    (("device", 0, "driver", "decoder_options", "time_unit"), "min"),
    (("device", 0, "driver", "decoder_options", "delimiter"), ""),
    (("device", 0, "driver", "decoder_options", "delimeter"), ";"),
    (("device", 0, "limit", 0, "letter"), "X"),
    (("device", 0, "limit", 0, "axes"), "g"),
    (("device", 0, "limit", 0, "hold"), "often"),
    (("device", 0, "limit", 0, "below"), "low"),
    (("device", 1, "model"), "none"),
    (("device", 1, "driver", "interface"), "socketscan"),
    (("device", 1, "driver", "bitrate"), "fast"),
    (("device", 1, "driver", "decoder_options", "window"), -1.0),
    (("device", 1, "driver", "decoder_options", "source"), 256),
    (("device", 1, "driver", "decoder_options", "tick"), 0.0),
    (("device", 1, "driver", "decoder_options", "join"), "conter"),
    (("device", 1, "driver", "decoder_options", "valid"), "AngularRateInformation.Valid"),
    (("device", 1, "driver", "decoder_options", "counter"), "AngularRate.Count"),
    (("device", 1, "driver", "decoder_options", "signals", "gx"), "AngularRateInformation.Rolling"),
    (("device", 1, "driver", "decoder_options", "signals", "gy"), 3),
    (("device", 1, "driver", "decoder_options", "signals", "gw"), "AngularRateInformation.RollRate"),
    (("device", 2, "driver", "seed"), -1),
    (("device", 2, "driver", "speed"), 0.0),
    (("device", 2, "driver", "faults", "lost"), 2.0),
    (("device", 2, "driver", "faults", "lots"), 1.0),
    (("device", 3, "driver", "path"), "b.csv"),
    (("device", 3, "driver", "speed"), "slow"),
    (("device", 3, "driver", "rate"), -1.0),
    (("device", 4, "driver", "key"), "##"),
    (("device", 4, "driver", "mode"), "pear"),
    (("device", 4, "driver", "decoder"), "stim300"),
    (("device", 5, "driver", "port"), "tcp://x"),
    (("device", 5, "driver", "decoder_options", "rate"), -1.0),
    (("device", 5, "driver", "decoder_options", "identifier"), 1),
    (("device", 5, "driver", "decoder_options", "accelerometer_range"), "3g"),
    (("zenoh", "mode"), "pear"),
    (("zenoh", "prefix"), "a/*"),
    (("zenoh", "connect"), ["7447"]),
    (("zenoh", "config"), "none.json5"),
    (("viewer", "mode"), "window"),
    (("viewer", "port"), 70000),
    (("viewer", "memory"), "lots"),
    (("storage", "segment"), "1s"),
    (("storage", "keep"), "long"),
    (("storage", "disk_share"), 2.0),
    (("hook", 0, "on"), ["limit_cross"]),
    (("hook", 0, "devices"), ["z"]),
    (("hook", 0, "command"), ["mail"]),
    (("hook", 0, "timeout"), "never"),
    (("metrics", "listen"), "9464"),
    (("log", "level"), "loud"),
    (("log", "format"), 3),
]


def made_wrong(*mistakes):
    """The text of the right configuration with these mistakes in it."""
    table = json.loads(json.dumps(RIGHT))
    for path, value in mistakes:
        at = table
        for key in path[:-1]:
            at = at[key]
        at[path[-1]] = value
    return "\n".join(f"{key} = {as_toml(value)}" for key, value in table.items())


def as_toml(value):
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {as_toml(one)}" for key, one in value.items()) + " }"
    return f"[{', '.join(map(as_toml, value))}]" if isinstance(value, list) else json.dumps(value)


def test_every_mistake_is_told_whatever_else_is_wrong(tmp_path):
    (tmp_path / "a.csv").write_text("t,gx\n0,1\n")
    assert wrong(tmp_path, made_wrong()) == []
    alone = [wrong(tmp_path, made_wrong(mistake)) for mistake in MISTAKES]
    for (path, value), lines in zip(MISTAKES, alone, strict=True):
        assert len(lines) == 1, (path, value, lines)
    every = wrong(tmp_path, made_wrong(*MISTAKES))
    assert sorted(every) == sorted(line for (line,) in alone)


def test_required_keys_that_are_missing_hide_nothing(tmp_path):
    text = """[[device]]
rat = 1.0
[device.driver]
link = "serial"
baudrate = -1
decoder = "text"
decoder_options = { gyro_unit = "LSB", header = "one" }
[[device]]
name = "b"
driver = { link = "cam", decoder = "stim300", decoder_options = { rate = -1.0 } }
[[device]]
name = "c"
windw = 1.0
[[hook]]
key = "##"
[[device.limit]]
hold = "often"
"""
    places = [
        "device[0].rat:",
        "device[0].name",
        "device[0].driver.port: missing",
        "device[0].driver.baudrate",
        "device[0].driver.decoder_options.header",
        "device[0].driver.decoder_options.columns: missing",
        "device[0].driver.decoder_options.gyro_unit",
        'device b: driver.link: "cam"; possible are can, ',
        "device b: driver.decoder_options.rate",
        "device c: windw",
        "device c: driver: missing",
        "device c: limit[0].axes: missing",
        "device c: limit[0].letter: missing",
        "device c: limit[0].hold",
        "device c: limit[0]: no bound",
        "hook[0].key",
        "hook[0].on: missing",
    ]
    found = wrong(tmp_path, text)
    for place in places:
        assert len([line for line in found if line.startswith(place)]) == 1, (place, found)
    assert len(found) == len(places), found


@pytest.mark.parametrize("what", ["missing", "folder", "binary"])
def test_a_file_that_cannot_be_read(tmp_path, what):
    path = tmp_path / "my.toml"
    if what == "folder":
        path.mkdir()
    elif what == "binary":
        path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="no such file" if what == "missing" else "cannot be read"):
        load_config(path)


def test_paths_are_relative_to_the_file(tmp_path, monkeypatch):
    folder = tmp_path / "etc"
    folder.mkdir()
    monkeypatch.chdir(tmp_path)
    (folder / "my.csv").write_text("t,gx\n0,1\n")
    (folder / "z.json5").write_text("{}")
    path = folder / "my.toml"
    path.write_text(device(driver='driver = { link = "replay", path = "my.csv" }') + '[zenoh]\nconfig = "z.json5"')
    config = load_config(path)
    assert config.zenoh.config == folder / "z.json5"
    link = config.devices[0].link
    link.open()
    link.close()


# --- what is shipped


@pytest.mark.parametrize("path", sorted(CONFIG_FOLDER.glob("*.toml")), ids=lambda path: path.name)
def test_examples_are_right(path):
    reading = examine_config_file(path)
    config, lines = reading.config, reading.wrong
    assert [line for line in lines if "no such file" not in line] == []
    assert config is not None or lines


def test_every_link_can_be_named():
    known = {*module_lookup.list_modules(drivers.links, "_link")}
    for name in known:
        module = module_lookup.import_module(drivers.links, name, "_link")
        assert module.DEFAULT_DECODER in ("", *module_lookup.list_modules(drivers.decoders))


# --- words


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("90s", 90.0),
        ("30min", 1800.0),
        ("1h", 3600.0),
        ("2d", 172800.0),
        (" 1.5 h ", 5400.0),
        ("250ms", 0.25),
        ("60", 60.0),
        ("1e3s", 1000.0),
        (7, 7.0),
    ],
)
def test_durations(text, value):
    assert parse_duration_s(text) == pytest.approx(value)


@pytest.mark.parametrize("text", ["", "h", "1w", "-1h", "0s", "1.2.3s", "1 h 3 min", "1H", "nan"])
def test_words_that_are_no_durations(text):
    with pytest.raises(ConfigError, match="not a duration"):
        parse_duration_s(text)


@pytest.mark.parametrize(("text", "value"), [("10 Hz", 0.1), ("0.5Hz", 2.0), ("always", 0.0)])
def test_rates(text, value):
    assert parse_rate_as_period(text, "always") == value


@pytest.mark.parametrize("text", ["", "10", "10hz", "0 Hz", "-1 Hz", "1.1.1 Hz"])
def test_words_that_are_no_rates(text):
    with pytest.raises(ConfigError, match="not a rate"):
        parse_rate_as_period(text, "always")


def test_the_viewer_opens_on_so_much_of_what_is_kept(tmp_path):
    path = tmp_path / "my.toml"
    path.write_text(device() + '[viewer]\nhistory = "12h"\n[storage]\nfolder = "kept"\n')
    assert load_config(path).viewer.history == 43_200.0
    path.write_text(device() + '[viewer]\nhistory = "12h"\n[storage]\nfolder = "kept"\nhistory = false\n')
    with pytest.raises(ConfigError, match="there is no history to show"):
        load_config(path)


def test_viewer_modes():
    for mode in ("auto", "native", "web", "none", "a.rrd"):
        check_viewer_mode(mode)
    with pytest.raises(ConfigError, match='"nativ"; possible are native, '):
        check_viewer_mode("nativ")


def test_virtual_model_may_be_a_file_beside_the_configuration(tmp_path):
    (tmp_path / "mine.toml").write_text((CONFIG_FOLDER / "models" / "consumer-mems.toml").read_text())
    path = tmp_path / "my.toml"
    path.write_text(device(driver='driver = { link = "virtual", model = "mine.toml", seed = 3 }'))
    link = load_config(path).devices[0].link
    assert isinstance(link, VirtualTable)
    assert Path(link.model) == tmp_path / "mine.toml"


def test_the_model_in_force_is_a_file_beside_the_configuration_or_a_name_of_the_catalogue(tmp_path):
    (tmp_path / "mine.toml").write_text((CONFIG_FOLDER / "models" / "bmi088.toml").read_text())
    path = tmp_path / "my.toml"
    given = {
        'model = "mine.toml"': tmp_path / "mine.toml",
        'model = "bmi088"': CONFIG_FOLDER / "models" / "bmi088.toml",
    }
    for text, found in given.items():
        path.write_text(device(text + '\nreconcile_folder = "reports"'))
        (one,) = load_config(path).devices
        assert (one.model, one.reconcile_folder) == (found, tmp_path / "reports")
    path.write_text(device())
    (one,) = load_config(path).devices
    assert (one.model, one.reconcile_folder) == (None, None)
    path.write_text(device('model = "bmi08"'))
    assert examine_config_file(path).wrong[0].endswith('did you mean "bmi088"?')


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("", 600.0),
        ('thermal_interval = "1h"', 3600.0),
        ("thermal_interval = 90", 90.0),
        ('thermal_interval = "off"', None),
    ],
)
def test_the_interval_that_is_held_against_temperature(tmp_path, text, found):
    path = tmp_path / "my.toml"
    path.write_text(device(text))
    assert load_config(path).devices[0].thermal_s == found


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (
            'thermal_interval = "none"',
            'thermal_interval: "none" is not a duration; write seconds, or "90s", "30min", "1h", "2d", or "off"',
        ),
        ("rate = 10.0\nthermal_interval = 0.5", "thermal_interval: 0.5 s; possible are 0.8 s (8 samples) to 1 d"),
        ('thermal_interval = "2d"', "thermal_interval: 2 d is outside the supported range 1 µs to 1 d"),
        ("thermal_interval = -3", "thermal_interval: -3 s is outside the supported range 1 µs to 1 d"),
    ],
)
def test_an_interval_that_cannot_be_says_why(tmp_path, text, says):
    path = tmp_path / "my.toml"
    path.write_text(device(text))
    (line,) = examine_config_file(path).wrong
    assert says in line


@pytest.mark.parametrize(
    ("decoder", "carrier"), [("vectornav_ascii", "bytes"), ("ros2_imu", "messages"), ("samples", "messages")]
)
def test_a_virtual_device_speaks_any_wire_format(tmp_path, decoder, carrier):
    path = tmp_path / "my.toml"
    path.write_text(device(driver=f'driver = {{ link = "virtual", decoder = "{decoder}", faults = {{ lost = 0.1 }} }}'))
    found = load_config(path).devices[0]
    assert found.decoder.carrier == carrier
    assert isinstance(found.link, VirtualTable)
    assert (found.link.faults.lost, found.link.faults.clock) == (0.1, 1.0)


def test_windows_that_are_accepted_are_those_that_the_estimator_can_hold():
    assert WINDOW_SAMPLES == (MIN_LENGTH, MAX_LENGTH)


@pytest.mark.parametrize("name", ["a" * 300, "~nobody-of-that-name/x", "\0"])
def test_a_name_that_no_file_can_have_is_no_file(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="neither a file nor one of those shipped"):
        resolve_model_path(name, tmp_path)
