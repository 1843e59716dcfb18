"""Processor time and size of a scrape of ``[metrics]`` and of a batch of ``[influx]``.

``python -m tests.experiments.benchmarks.metrics`` prints both. The processor time of a scrape includes the client. The
processor time of a batch is the time that the main loop spends on formatting.
"""

import statistics
import time
import urllib.request

from monitor.daemon.operations.prometheus_metrics import MetricsOutput
from monitor.daemon.outputs.influx_output import format_lines
from monitor.settings.loading import MetricsAddress
from tests.monitor.publishing import example_results

SCRAPES = 30


def main() -> None:
    """Measure 1, 16 and 100 devices."""
    for devices in (1, 16, 100):
        output = MetricsOutput(MetricsAddress("127.0.0.1", 0))
        for i in range(devices):
            output.publish_health(f"device-{i}", 0.0, example_results.make_health())
            output.publish_result(f"device-{i}", 0.0, 0, example_results.make_estimate())
        output.start()
        while not output.port:
            time.sleep(0.01)
        took_s, size = [], 0
        for _ in range(SCRAPES):
            begun_s = time.process_time()
            with urllib.request.urlopen(f"http://127.0.0.1:{output.port}/metrics") as response:
                size = len(response.read())
            took_s.append(time.process_time() - begun_s)
        output.close()
        print(f"{devices:4d} devices, scrape: {1e3 * statistics.median(took_s):6.1f} ms, {size / 1e3:7.1f} kB")
        took_s = []
        for _ in range(SCRAPES):
            begun_s = time.process_time()
            size = len("\n".join(format_lines(output.read_metrics())).encode())
            took_s.append(time.process_time() - begun_s)
        print(f"{devices:4d} devices, batch:  {1e3 * statistics.median(took_s):6.1f} ms, {size / 1e3:7.1f} kB")


if __name__ == "__main__":
    main()
