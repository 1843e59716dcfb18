"""Checks of the outputs of a configuration: zenoh, viewer, metrics, InfluxDB, ROS 2 and reports."""

from collections.abc import Iterator
from importlib.util import find_spec
from urllib.parse import urlsplit

from drivers.host.extras import find_missing_packages, install_command
from monitor.commands.doctor.finding import DoctorFinding, check_permissions, doubt, well, wrong
from monitor.commands.doctor.network import LOOPBACK, TCP_ENDPOINT, check_port_free, check_reachable
from monitor.settings.loading import Config


def check_zenoh(config: Config) -> Iterator[DoctorFinding]:
    """Check the ports, the endpoints and the file of the zenoh session."""
    own = config.zenoh
    if own.mode == "none":
        return
    if own.mode != "client":
        for endpoint in own.listen or ():
            yield check_port_free("zenoh", endpoint)
    for endpoint in own.connect:
        yield check_reachable("zenoh", endpoint)
    if own.config is not None:
        yield check_permissions(own.config, "zenoh file")
        return
    for endpoint in own.listen or ():
        address = TCP_ENDPOINT.fullmatch(endpoint)
        if address is not None and not address[1].startswith(LOOPBACK):
            text = f"{endpoint}: everyone who reaches this machine can read all data and send commands"
            yield doubt("zenoh", text, "listen on 127.0.0.1, or use TLS and access control")


def check_viewer(config: Config) -> Iterator[DoctorFinding]:
    """Check that the package of the viewer is installed."""
    mode = config.viewer.mode
    if mode == "none":
        return
    if find_spec("rerun") is None:
        text = f'viewer.mode is "{mode}", but rerun-sdk is not installed: there will be no live view'
        yield doubt("viewer", text, f'{install_command("imu-monitor[viewer]")}, or mode = "none"')
    else:
        yield well("viewer", f"rerun-sdk is installed, mode {mode}")


def check_metrics(config: Config) -> Iterator[DoctorFinding]:
    """Check the package and the port of the metrics."""
    own = config.metrics
    if own is None:
        return
    if find_spec("prometheus_client") is None:
        text = "metrics.listen is set, but prometheus-client is not installed"
        yield wrong("metrics", text, install_command("imu-monitor[metrics]"))
        return
    host = f"[{own.host}]" if ":" in own.host else own.host
    yield check_port_free("metrics", f"tcp/{host}:{own.port}")
    if not own.host.startswith(LOOPBACK):
        text = f"{own.host}: everyone who reaches this machine can read the metrics"
        yield doubt("metrics", text, "listen on 127.0.0.1, and let a local collector forward them")


def check_influx(config: Config) -> Iterator[DoctorFinding]:
    """Check the server, the token and the encryption of the output to InfluxDB."""
    own = config.influx
    if own is None or own.url is None:
        return
    parts = urlsplit(own.url)
    host = str(parts.hostname)
    port = parts.port or (443 if parts.scheme == "https" else 80)
    yield check_reachable("influx", f"tcp/[{host}]:{port}" if ":" in host else f"tcp/{host}:{port}")
    if own.token_file is not None:
        yield check_permissions(own.token_file, "influx token", secret=True)
    if parts.scheme == "http" and not host.startswith(LOOPBACK):
        text = f"{host}: everyone on the network between can read the results and the token"
        yield doubt("influx", text, "use https")


def check_ros2_routers(config: Config) -> Iterator[DoctorFinding]:
    """Check that the routers used by the ROS 2 output respond."""
    for endpoint in config.ros2.connect if config.ros2 is not None else ():
        yield check_reachable("ros2", endpoint)


def check_reconcile_packages(config: Config) -> Iterator[DoctorFinding]:
    """If a folder for reports is configured, check that the packages for the command ``reconcile`` are installed."""
    missing = " and ".join(find_missing_packages("reconcile"))
    if missing and any(one.reconcile_folder for one in config.devices):
        text = f"reconcile_folder is set, but {missing} is not installed: the service refuses command/reconcile"
        yield doubt("reconcile", text, install_command("imu-monitor[reconcile]"))
