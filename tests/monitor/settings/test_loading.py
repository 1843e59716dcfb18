"""Tests of loading the configuration: every mistake is reported with its key, and shipped files are valid."""

import json
from pathlib import Path

import pytest

import drivers.decoders
import drivers.links
from drivers.decoders.text_lines.vectornav_ascii import VectornavAsciiDecoder
from drivers.driver import AxisMap
from drivers.errors import ConfigError
from drivers.validation import module_lookup
from monitor.common.shipped_config_paths import CONFIG_FOLDER, resolve_model_path
from monitor.estimation.allan.window import MAX_LENGTH, MIN_LENGTH
from monitor.settings.loading import (
    MAX_DEVICES,
    MAX_HOOKS,
    WINDOW_SAMPLES,
    VirtualTable,
    check_viewer_mode,
    examine_config_file,
    load_config,
    parse_duration_s,
    parse_rate_as_period,
)

DRIVER = 'driver = { link = "serial", port = "/dev/null", decoder = "vectornav_ascii" }'


def list_mistakes(tmp_path, text):
    path = tmp_path / "my.toml"
    path.write_text(text, "utf-8")
    reading = examine_config_file(path)
    config, lines = reading.config, reading.wrong
    assert (config is None) == bool(lines)
    assert all(line.startswith(f"{path}: ") and "\n" not in line for line in lines)
    return [line.removeprefix(f"{path}: ") for line in lines]


def format_device(extra="", name="a", driver=DRIVER):
    return f'[[device]]\nname = "{name}"\n{extra}\n{driver}\n'


def test_device_needs_only_its_name_and_driver(tmp_path):
    path = tmp_path / "my.toml"
    path.write_text(format_device())
    (device,) = load_config(path).devices
    assert (device.name, device.rate_hz, device.window_s, device.tau) == ("a", None, 3600.0, "octave")
    assert (device.refit_s, device.publish_s, device.silence_s) == (0.1, 0.1, 3.0)
    assert device.axes == AxisMap()
    assert isinstance(device.decoder, VectornavAsciiDecoder)


LIMIT = "[[device.limit]]\n"
HOOK = "[[hook]]\n"
INVALID_CONFIGS = {
    "limit without a bound": (
        format_device() + LIMIT + 'axes = "gz"\nletter = "N"',
        ["device a: limit[0]: no bound; add above, below or times_model"],
    ),
    "limit of no axis": (
        format_device() + LIMIT + 'axes = "g"\nletter = "N"\nabove = 1.0',
        ['device a: limit[0].axes: "g"; possible are gx, gy, gz, g*, ax, ay, az, a*, *'],
    ),
    "limit of no letter": (
        format_device() + LIMIT + 'axes = "gz"\nletter = "X"\nabove = 1.0',
        ['device a: limit[0].letter: "X"; possible are Q, N, B, K, R'],
    ),
    "limit without a letter": (
        format_device() + LIMIT + 'axes = "gz"\nabove = 1.0',
        ["device a: limit[0].letter: missing"],
    ),
    "limit without a model": (
        format_device() + LIMIT + 'axes = "gz"\nletter = "N"\ntimes_model = 1.5',
        ["device a: limit[0].times_model: the device has no model in force; add model"],
    ),
    "limit given twice": (
        format_device('model = "consumer-mems"') + LIMIT + 'axes = "gz"\nletter = "N"\ntimes_model = 1.5\nabove = 1.0',
        ["device a: limit[0]: above and times_model are the same bound; leave one out"],
    ),
    "contradicting limits": (
        format_device() + LIMIT + 'axes = "gz"\nletter = "N"\nbelow = 2.0\nabove = 1.0',
        ["device a: limit[0]: below 2 must be less than above 1"],
    ),
    "limit with invalid hold time": (
        format_device() + LIMIT + 'axes = "gz"\nletter = "N"\nabove = 1.0\nhold = "often"',
        ['device a: limit[0].hold: "often" is not a duration'],
    ),
    "hook without events": (
        format_device() + HOOK + 'on = []\nkey = "x"',
        ['hook[0].on: empty; write kinds of events, or ["*"]'],
    ),
    "hook on an unknown event": (
        format_device() + HOOK + 'on = ["limit_cross"]\nkey = "x"',
        ['hook[0].on[0]: "limit_cross"; possible are limit_crossed, limit_back, '],
    ),
    "hook of an unknown device": (
        format_device() + HOOK + 'on = ["*"]\ndevices = ["b"]\nkey = "x"',
        ['hook[0].devices: "b"; possible are a'],
    ),
    "hook that does nothing": (format_device() + HOOK + 'on = ["*"]', ["hook[0]: nothing to do; add command or key"]),
    "hook without a path": (
        format_device() + HOOK + 'on = ["*"]\ncommand = ["mail"]',
        ['hook[0].command: "mail" is not a path; write the path of the program, e.g. "/usr/bin/mail"'],
    ),
    "missing hook program": (format_device() + HOOK + 'on = ["*"]\ncommand = ["/none/x"]', ["/none/x: no such file"]),
    "hook file that is not executable": (
        format_device() + HOOK + f'on = ["*"]\ncommand = ["{CONFIG_FOLDER}/demo.toml"]',
        ["demo.toml: not executable; chmod +x it"],
    ),
    "hook with a wildcard key": (
        format_device() + HOOK + 'on = ["*"]\nkey = "site/*"',
        ["hook[0].key: expected a zenoh key such as"],
    ),
    "hook without zenoh": (
        format_device() + HOOK + 'on = ["*"]\nkey = "x"\n[zenoh]\nmode = "none"',
        ['hook[0].key: zenoh.mode is "none", so the message cannot be published'],
    ),
    "metrics without a host": (
        format_device() + '[metrics]\nlisten = "9464"',
        ['metrics.listen: "9464" is not a host and port; write "127.0.0.1:9464"'],
    ),
    "influx without a path": (
        format_device() + '[influx]\nurl = "http://127.0.0.1:8086"',
        [
            'influx.url: "http://127.0.0.1:8086" is not the address of a write endpoint; write "http://127.0.0.1:8086/api'
        ],
    ),
    "influx of another scheme": (
        format_device() + '[influx]\nurl = "udp://127.0.0.1:8089/x"',
        ["is not the address of a write endpoint"],
    ),
    "influx with an impossible port": (
        format_device() + '[influx]\nurl = "http://127.0.0.1:99999/write"',
        ["is not the address of a write endpoint"],
    ),
    "influx with a password": (
        format_device() + '[influx]\nurl = "http://me:hunter2@127.0.0.1:8086/write?db=x"',
        ["influx.url: the address contains a password; write user:password into token_file instead"],
    ),
    "influx with a password as parameter": (
        format_device() + '[influx]\nurl = "http://127.0.0.1:8086/write?db=x&u=me&p=hunter2"',
        ["influx.url: the address contains a password; write user:password into token_file instead"],
    ),
    "influx with another precision": (
        format_device() + '[influx]\nurl = "http://127.0.0.1:8086/write?db=x&precision=s"',
        ["influx.url: remove precision from the address, because the times are sent in nanoseconds"],
    ),
    "influx with a token but no server": (
        format_device() + '[influx]\ntoken_file = "/dev/null"',
        ["influx.token_file: there is no server to send the token to; add url"],
    ),
    "influx with an interval below that of the status": (
        format_device() + '[influx]\ninterval = "100ms"',
        ["influx.interval: "],
    ),
    "unknown key": (format_device("windw = 60.0"), ['device a: windw: unknown key; did you mean "window"?']),
    "unknown table": ("[zenho]\n" + format_device(), ['zenho: unknown key; did you mean "zenoh"?']),
    "unknown key of zenoh": (
        format_device() + '[zenoh]\nlisten_to = ["x"]',
        ['zenoh.listen_to: unknown key; did you mean "listen"?'],
    ),
    "unknown key of the link": (
        format_device(driver='driver = { link = "serial", port = "x", baud = 1, decoder = "stim300" }'),
        ['device a: driver.baud: unknown key; did you mean "baudrate"?'],
    ),
    "unknown key of the decoder": (
        format_device(
            driver='driver = { link = "serial", port = "x", decoder = "stim300", decoder_options = { range = "5g" } }'
        ),
        ["device a: driver.decoder_options.range: unknown key"],
    ),
    "wrong type": (
        format_device('rate = "fast"'),
        ['device a: rate: expected a number from 0.001 Hz to 1 MHz, got "fast"'],
    ),
    "rate not above 0": (
        format_device("rate = 0"),
        ["device a: rate: 0 Hz is outside the supported range 0.001 Hz to 1 MHz"],
    ),
    "rate not a number": (format_device("rate = nan"), ["device a: rate: nan Hz is outside the supported range"]),
    "infinite rate": (format_device("rate = inf"), ["device a: rate: inf Hz is outside the supported range"]),
    "name missing": (f"[[device]]\n{DRIVER}", ["device[0].name: missing"]),
    "driver missing": ('[[device]]\nname = "a"', ["device a: driver: missing"]),
    "no device": ("", ["device: there is none"]),
    "two of one name": (format_device() + format_device(), ['2 devices are named "a"; names must be unique']),
    "impossible name": (format_device(name="a/b"), ['device[0].name: "a/b"; letters']),
    "no link": (
        format_device(driver='driver = { port = "x" }'),
        ["device a: driver.link: missing; possible are can, "],
    ),
    "unknown link": (
        format_device(driver='driver = { link = "seral" }'),
        ['driver.link: "seral"; possible are serial, '],
    ),
    "loopback link": (
        format_device(driver='driver = { link = "loopback" }'),
        ['link: "loopback"; possible'],
    ),
    "link that is no text": (format_device(driver="driver = { link = 3 }"), ["driver.link: "]),
    "unknown protocol": (
        format_device(driver='driver = { link = "serial", port = "x", decoder = "stim30" }'),
        ['device a: driver.decoder: "stim30"; possible are stim300, '],
    ),
    "protocol missing": (
        format_device(driver='driver = { link = "serial", port = "x" }'),
        ["driver.decoder: missing; possible are aceinna_dmu, "],
    ),
    "decoder that is no text": (
        format_device(driver='driver = { link = "serial", port = "x", decoder = 3 }'),
        ["driver.decoder: "],
    ),
    "decoder that does not fit": (
        format_device(driver='driver = { link = "serial", port = "x", decoder = "ros2_imu" }'),
        ["device a: driver.decoder: ros2_imu reads messages, link serial provides bytes: possible are"],
    ),
    "options that are no table": (
        format_device(driver='driver = { link = "serial", port = "x", decoder = "text", decoder_options = 3 }'),
        ["driver.decoder_options: expected a table"],
    ),
    "bad unit": (
        format_device(
            driver='driver = { link = "serial", port = "x", decoder = "text", '
            'decoder_options = { columns = ["gx"], gyro_unit = "deg/h2" } }'
        ),
        ['driver.decoder_options.gyro_unit: "deg/h2" is not a unit of angular rate; possible are deg/h, deg/hr, '],
    ),
    "port missing": (
        format_device(driver='driver = { link = "serial", decoder = "stim300" }'),
        ["device a: driver.port: missing"],
    ),
    "window that is not a duration": (
        format_device('window = "1 week"'),
        ['device a: window: "1 week" is not a duration'],
    ),
    "window too short": (
        format_device("rate = 100\nwindow = 0.5"),
        ["50 samples; possible are 100 to 10000000: 1 to 100000 s"],
    ),
    "window too long": (format_device('rate = 1000\nwindow = "1d"'), ["86400000 samples"]),
    "window of nan": (format_device("window = nan"), ["window"]),
    "infinite window": (format_device("window = inf"), ["window"]),
    "unknown tau": (
        format_device('tau = "octaves"'),
        ['tau: expected "octave", "decade10" or a list, got "octaves"'],
    ),
    "tau not above 0": (
        format_device("tau = [1.0, -1.0]"),
        ["device a: tau[1]: -1 s is outside the supported range 1 µs to 36525 d"],
    ),
    "impossible tau": (
        format_device("rate = 100\nwindow = 60\ntau = [100.0]"),
        ["device a: tau: none of [100.0] s lies"],
    ),
    "empty tau": (format_device("rate = 100\ntau = []"), ["device a: tau: "]),
    "refit": (
        format_device('refit = "often"'),
        ['device a: refit: "often" is not a rate; write "10 Hz" or "every sample"'],
    ),
    "publish": (
        format_device('publish = "0 Hz"'),
        ['device a: publish: "0 Hz" is not a rate; write "10 Hz" or "every block"'],
    ),
    "axes": (
        format_device('axes = { gx = "up" }'),
        ['device a: axes: gx = "up": expected two axes of the same kind out of gx gy gz ax ay az'],
    ),
    "axis used twice": (
        format_device('axes = { gx = "gy", ax = "-az" }'),
        [
            'device a: axes: gx = "gy" and gy = "gy" (default) use the same axis of the sensor, and gx is lost',
            'device a: axes: ax = "-az" and az = "az" (default) use the same axis of the sensor, and ax is lost',
        ],
    ),
    "missing model": (
        format_device('model = "models/none.toml"'),
        ['device a: model: no model "models/none.toml"'],
    ),
    "silence below 0": (
        format_device(driver='driver = { link = "serial", port = "x", decoder = "stim300", silence = "3" }'),
        ['device a: driver.silence: expected a number from 1 ms to 36525 d, or 0, got "3"'],
    ),
    "infinite virtual speed": (
        format_device(driver='driver = { link = "virtual", speed = inf }'),
        ["device a: driver.speed: inf times is outside the supported range 0.001 to 10000 times"],
    ),
    "unknown virtual model": (
        format_device(driver='driver = { link = "virtual", model = "none" }'),
        ['no model "none"'],
    ),
    "unknown fault": (
        format_device(driver='driver = { link = "virtual", faults = { lots = 1 } }'),
        ['device a: driver.faults.lots: unknown key; did you mean "lost"?'],
    ),
    "fault share above 1": (
        format_device(driver='driver = { link = "virtual", faults = { lost = 1.5 } }'),
        ["device a: driver.faults.lost: 1.5 is outside the supported range 0 to 1"],
    ),
    "sum of fault shares above 1": (
        format_device(driver='driver = { link = "virtual", faults = { lost = 0.6, cut = 0.6 } }'),
        ["device a: driver.faults: lost, repeated, flipped and cut are shares of all samples: their sum is at most 1"],
    ),
    "faults that are no table": (
        format_device(driver='driver = { link = "virtual", faults = "some" }'),
        ['device a: driver.faults: expected a table, got "some"'],
    ),
    "missing replay file": (
        format_device(driver='driver = { link = "replay", path = "a.jpg" }'),
        ["a.jpg: no such file"],
    ),
    "viewer": (
        format_device() + '[viewer]\nmode = "window"',
        ['viewer.mode: "window"; possible are none, web, auto, nat'],
    ),
    "viewer's port": (
        format_device() + "[viewer]\nport = 70000",
        ["viewer.port: 70000 is outside the supported range"],
    ),
    "viewer's history": (
        format_device() + '[viewer]\nhistory = "soon"',
        ['viewer.history: "soon" is not a duration'],
    ),
    "viewer's memory": (format_device() + "[viewer]\nmemory = 3", ["viewer.memory: expected text in quotes, got 3"]),
    "zenoh's mode": (format_device() + '[zenoh]\nmode = "pear"', ['zenoh.mode: "pear"; possible are peer, ']),
    "zenoh's prefix": (format_device() + '[zenoh]\nprefix = "a/*"', ["zenoh.prefix: "]),
    "log": (format_device() + '[log]\nlevel = "loud"', ['log.level: "loud"; possible are info, debug, error, warning']),
    "device that is no list": ("device = 3", ["device: expected a list, got 3"]),
    "not TOML": ("[[device]\n", ["not TOML: "]),
}


@pytest.mark.parametrize("case", INVALID_CONFIGS)
def test_invalid_configuration_is_reported_with_its_key(tmp_path, case):
    text, expected = INVALID_CONFIGS[case]
    lines = list_mistakes(tmp_path, text)
    assert len(lines) == len(expected)
    for line, part in zip(lines, expected, strict=True):
        assert part in line


@pytest.mark.parametrize(
    ("axes", "mirrored"),
    [
        ('gy = "gz", gz = "-gy", ax = "-ax", ay = "-ay"', []),
        ('gx = "gy", gy = "gz", gz = "gx"', []),
        ('gx = "-gx"', ["gyroscopes"]),
        ('gx = "gy", gy = "gx", ax = "-ax", ay = "-ay", az = "-az"', ["gyroscopes", "accelerometers"]),
    ],
)
def test_mirrored_axes_give_a_warning(tmp_path, axes, mirrored):
    (tmp_path / "my.toml").write_text(format_device(f"axes = {{ {axes} }}"))
    warnings = load_config(tmp_path / "my.toml").warnings
    assert len(warnings) == len(mirrored)
    for line, kind in zip(warnings, mirrored, strict=True):
        assert f"device a: axes: the {kind} are mirrored" in line


def test_recording_is_not_taken_for_a_configuration(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("t,gx\n0,1\n")
    (line,) = examine_config_file(path).wrong
    assert line.startswith(f"{path}: not TOML: ")
    assert line.endswith("; imu-monitor analyze reads recordings")


def test_unknown_dbc_signal_is_reported(tmp_path):
    dbc = sorted((CONFIG_FOLDER / "dbc").glob("*.dbc"))[0]
    (line,) = list_mistakes(
        tmp_path,
        format_device(
            driver=f'driver = {{ link = "can", channel = "vcan0", decoder = "dbc", '
            f'decoder_options = {{ file = "{dbc}", signals = {{ gz = "NoSuchSignal" }} }} }}'
        ),
    )
    assert line.startswith("device a: driver.decoder_options.signals.gz: ")
    assert "NoSuchSignal" in line


def test_file_of_unknown_type_cannot_be_replayed(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"")
    (line,) = list_mistakes(tmp_path, format_device(driver='driver = { link = "replay", path = "a.jpg" }'))
    assert "has no suffix of a file to replay" in line


def test_all_mistakes_are_reported_at_once(tmp_path):
    text = (
        format_device("rate = -1\nwindw = 3")
        + format_device(
            'window = "soon"\nrefit = "x"\naxes = { gx = "q" }', "b", 'driver = { link = "serial", bautrate = 1 }'
        )
        + '[log]\nlevel = "x"\n[viewer]\nmode = "y"\n'
    )
    lines = list_mistakes(tmp_path, text)
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


VALID_CONFIG = {
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
    "influx": {},
    "ros2": {},
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
    (("influx", "url"), "127.0.0.1:8086"),
    (("influx", "interval"), "often"),
    (("device", 0, "frame_id"), "/imu_link"),
    (("ros2", "domain"), 233),
    (("ros2", "connect"), ["7447"]),
    (("ros2", "namespace"), "robot-1"),
    (("ros2", "imu"), "data"),
    (("log", "level"), "loud"),
    (("log", "format"), 3),
]


def format_with_mistakes(*mistakes):
    """Return the valid configuration as TOML with these mistakes."""
    table = json.loads(json.dumps(VALID_CONFIG))
    for path, value in mistakes:
        at = table
        for key in path[:-1]:
            at = at[key]
        at[path[-1]] = value
    return "\n".join(f"{key} = {format_toml_value(value)}" for key, value in table.items())


def format_toml_value(value):
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {format_toml_value(item)}" for key, item in value.items()) + " }"
    return f"[{', '.join(map(format_toml_value, value))}]" if isinstance(value, list) else json.dumps(value)


def test_each_mistake_is_reported_in_spite_of_the_others(tmp_path):
    (tmp_path / "a.csv").write_text("t,gx\n0,1\n")
    assert list_mistakes(tmp_path, format_with_mistakes()) == []
    separate = [list_mistakes(tmp_path, format_with_mistakes(mistake)) for mistake in MISTAKES]
    for (path, value), lines in zip(MISTAKES, separate, strict=True):
        assert len(lines) == 1, (path, value, lines)
    combined = list_mistakes(tmp_path, format_with_mistakes(*MISTAKES))
    assert sorted(combined) == sorted(line for (line,) in separate)


def test_missing_required_keys_hide_no_other_mistakes(tmp_path):
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
    starts = [
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
    found = list_mistakes(tmp_path, text)
    for start in starts:
        assert len([line for line in found if line.startswith(start)]) == 1, (start, found)
    assert len(found) == len(starts), found


@pytest.mark.parametrize("kind", ["missing", "folder", "binary"])
def test_unreadable_file_is_refused(tmp_path, kind):
    path = tmp_path / "my.toml"
    if kind == "folder":
        path.mkdir()
    elif kind == "binary":
        path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="no such file" if kind == "missing" else "cannot be read"):
        load_config(path)


def test_paths_are_relative_to_the_file(tmp_path, monkeypatch):
    folder = tmp_path / "etc"
    folder.mkdir()
    monkeypatch.chdir(tmp_path)
    (folder / "my.csv").write_text("t,gx\n0,1\n")
    (folder / "z.json5").write_text("{}")
    path = folder / "my.toml"
    path.write_text(
        format_device(driver='driver = { link = "replay", path = "my.csv" }') + '[zenoh]\nconfig = "z.json5"'
    )
    config = load_config(path)
    assert config.zenoh.config == folder / "z.json5"
    link = config.devices[0].link
    link.open()
    link.close()


# --- shipped files


@pytest.mark.parametrize("path", sorted(CONFIG_FOLDER.glob("*.toml")), ids=lambda path: path.name)
def test_shipped_configurations_are_valid(path):
    reading = examine_config_file(path)
    config, lines = reading.config, reading.wrong
    assert [line for line in lines if "no such file" not in line] == []
    assert config is not None or lines


def test_every_link_has_a_known_default_decoder():
    links = {*module_lookup.list_modules(drivers.links, "_link")}
    for name in links:
        module = module_lookup.import_module(drivers.links, name, "_link")
        assert module.DEFAULT_DECODER in ("", *module_lookup.list_modules(drivers.decoders))


# --- durations and rates


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
def test_durations_are_parsed(text, value):
    assert parse_duration_s(text) == pytest.approx(value)


@pytest.mark.parametrize("text", ["", "h", "1w", "-1h", "0s", "1.2.3s", "1 h 3 min", "1H", "nan"])
def test_invalid_durations_are_refused(text):
    with pytest.raises(ConfigError, match="not a duration"):
        parse_duration_s(text)


@pytest.mark.parametrize(("text", "value"), [("10 Hz", 0.1), ("0.5Hz", 2.0), ("always", 0.0)])
def test_rates_are_parsed(text, value):
    assert parse_rate_as_period(text, "always") == value


@pytest.mark.parametrize("text", ["", "10", "10hz", "0 Hz", "-1 Hz", "1.1.1 Hz"])
def test_invalid_rates_are_refused(text):
    with pytest.raises(ConfigError, match="not a rate"):
        parse_rate_as_period(text, "always")


def test_viewer_history_needs_stored_history(tmp_path):
    path = tmp_path / "my.toml"
    path.write_text(format_device() + '[viewer]\nhistory = "12h"\n[storage]\nfolder = "kept"\n')
    assert load_config(path).viewer.history == 43_200.0
    path.write_text(format_device() + '[viewer]\nhistory = "12h"\n[storage]\nfolder = "kept"\nhistory = false\n')
    with pytest.raises(ConfigError, match="there is no history to show"):
        load_config(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[[device]]\nname = "a"\n' * (MAX_DEVICES + 1), "device: 1001 tables; at most 1000 are supported"),
        ("[[hook]]\n" * (MAX_HOOKS + 1), "hook: 1001 tables; at most 1000 are supported"),
        (f"[{'.'.join('a' * 500)}]\nx = 1\n", "nested too deep, at most 64 levels"),
        (f"{'.'.join('a' * 20_000)} = 1\n", "nested too deep, at most 64 levels"),
        (" . ".join(['"a"'] * 20_000) + " = 1\n", "nested too deep, at most 64 levels"),
        (f"x = {'[' * 200}{']' * 200}\n", "nested too deep, at most 64 levels"),
    ],
    ids=["devices", "hooks", "tables", "dotted key", "quoted key", "arrays"],
)
def test_configuration_that_is_too_large_is_refused(tmp_path, text, message):
    path = tmp_path / "c.toml"
    path.write_text(text)
    (line,) = examine_config_file(path).wrong
    assert message in line


def test_viewer_mode_is_checked():
    for mode in ("auto", "native", "web", "none", "a.rrd"):
        check_viewer_mode(mode)
    with pytest.raises(ConfigError, match='"nativ"; possible are native, '):
        check_viewer_mode("nativ")


def test_virtual_model_may_be_a_file_next_to_the_configuration(tmp_path):
    (tmp_path / "mine.toml").write_text((CONFIG_FOLDER / "models" / "consumer-mems.toml").read_text())
    path = tmp_path / "my.toml"
    path.write_text(format_device(driver='driver = { link = "virtual", model = "mine.toml", seed = 3 }'))
    link = load_config(path).devices[0].link
    assert isinstance(link, VirtualTable)
    assert Path(link.model) == tmp_path / "mine.toml"


def test_model_in_force_is_a_file_or_a_shipped_name(tmp_path):
    (tmp_path / "mine.toml").write_text((CONFIG_FOLDER / "models" / "bmi088.toml").read_text())
    path = tmp_path / "my.toml"
    given = {
        'model = "mine.toml"': tmp_path / "mine.toml",
        'model = "bmi088"': CONFIG_FOLDER / "models" / "bmi088.toml",
    }
    for text, found in given.items():
        path.write_text(format_device(text + '\nreconcile_folder = "reports"'))
        (device,) = load_config(path).devices
        assert (device.model, device.reconcile_folder) == (found, tmp_path / "reports")
    path.write_text(format_device())
    (device,) = load_config(path).devices
    assert (device.model, device.reconcile_folder) == (None, None)
    path.write_text(format_device('model = "bmi08"'))
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
def test_thermal_interval_is_parsed(tmp_path, text, found):
    path = tmp_path / "my.toml"
    path.write_text(format_device(text))
    assert load_config(path).devices[0].thermal_s == found


@pytest.mark.parametrize(
    ("text", "message"),
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
def test_invalid_thermal_interval_is_refused(tmp_path, text, message):
    path = tmp_path / "my.toml"
    path.write_text(format_device(text))
    (line,) = examine_config_file(path).wrong
    assert message in line


@pytest.mark.parametrize(
    ("decoder", "carrier"), [("vectornav_ascii", "bytes"), ("ros2_imu", "messages"), ("samples", "messages")]
)
def test_virtual_device_supports_any_carrier(tmp_path, decoder, carrier):
    path = tmp_path / "my.toml"
    path.write_text(
        format_device(driver=f'driver = {{ link = "virtual", decoder = "{decoder}", faults = {{ lost = 0.1 }} }}')
    )
    found = load_config(path).devices[0]
    assert found.decoder.carrier == carrier
    assert isinstance(found.link, VirtualTable)
    assert (found.link.faults.lost, found.link.faults.clock) == (0.1, 1.0)


def test_accepted_windows_are_those_of_the_estimator():
    assert WINDOW_SAMPLES == (MIN_LENGTH, MAX_LENGTH)


@pytest.mark.parametrize("name", ["a" * 300, "~nobody-of-that-name/x", "\0"])
def test_impossible_file_name_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="neither a file nor one of those shipped"):
        resolve_model_path(name, tmp_path)
