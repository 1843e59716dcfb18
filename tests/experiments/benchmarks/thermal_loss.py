"""Coverage of the interval of a thermal slope if samples are missing.

    python -m tests.experiments.benchmarks.thermal_loss [--records 600]

Each record lasts an hour at 10 Hz and is divided into 72 intervals. The temperature swings by ±10 °C in 1.5 cycles, and
the bias follows it with a slope of 0.05 per °C beside white noise of standard deviation 1. The random walk moves by
0.02 in an interval, and the flicker noise has B = 0.05. No code of ``monitor.noise`` is used.
"""

import argparse
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Floats
from monitor.drift.thermal.interval_means import compute_interval_means
from monitor.drift.thermal.thermal_fit import fit_thermal_model
from tests.experiments.benchmarks.machine import console, create_table
from tests.experiments.benchmarks.records import Noise, Records

RATE_HZ: Final = 10.0
INTERVAL_SAMPLES: Final = 500
SAMPLES: Final = 72 * INTERVAL_SAMPLES
SLOPE: Final = 0.05
NOISES: Final = ("white", "random walk", "flicker")
SHARES: Final = {"none": 0.0, "1 % at random": 0.01, "5 % at random": 0.05, "20 % at random": 0.2}
BURSTS: Final = "360 bursts of 10"
FLICKER: Final = Records(Noise(N=0.1, B=0.05), SAMPLES)


def simulate_noise(kind: str, rng: np.random.Generator) -> Floats:
    """Return the noise [SAMPLES] of a record."""
    if kind == "flicker":
        return FLICKER.simulate_six(rng)[:, 0]
    noise = rng.standard_normal(SAMPLES)
    if kind == "random walk":
        noise += 0.02 / INTERVAL_SAMPLES**0.5 * np.cumsum(rng.standard_normal(SAMPLES))
    return noise


def present_samples(loss: str, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return a mask [SAMPLES] that is True for the samples that are present."""
    if loss != BURSTS:
        return np.asarray(rng.random(SAMPLES) >= SHARES[loss]) if SHARES[loss] else np.ones(SAMPLES, np.bool_)
    present = np.ones(SAMPLES, np.bool_)
    for begin in rng.integers(0, SAMPLES - 10, 360):
        present[begin : begin + 10] = False
    return present


def measure(kind: str, records: int) -> dict[str, tuple[float, float]]:
    """Return for each loss the share of intervals that contain the slope, and the median width of the intervals."""
    ends: dict[str, list[tuple[float, float]]] = {loss: [] for loss in (*SHARES, BURSTS)}
    t = np.arange(SAMPLES) / SAMPLES
    for record in range(records):
        rng = np.random.default_rng([1000 + record, 7])
        temperature_c = 25.0 + 10.0 * np.sin(3.0 * np.pi * t + rng.uniform(0.0, 6.28))
        temperature_c += 0.3 * np.sin(22.0 * np.pi * t + rng.uniform(0.0, 6.28))
        bias = 9.81 + SLOPE * temperature_c + simulate_noise(kind, rng)
        for loss, found in ends.items():
            values, temperatures = np.where(present_samples(loss, rng), (bias, temperature_c), np.nan)
            means = compute_interval_means(values, temperatures, RATE_HZ, INTERVAL_SAMPLES / RATE_HZ)
            found.append(fit_thermal_model(means).slope_interval)
    both = {loss: np.array(found).T for loss, found in ends.items()}
    return {
        loss: (float(((lo <= SLOPE) & (hi >= SLOPE)).mean()), float(np.median(hi - lo)))
        for loss, (lo, hi) in both.items()
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=600)
    records = parser.parse_args().records
    heads = [f"{kind}: {what}" for kind in NOISES for what in ("correct", "width")]
    table = create_table(f"95 % intervals of a thermal slope, {records} records", "loss", *heads)
    found = [measure(kind, records) for kind in NOISES]
    for loss in (*SHARES, BURSTS):
        cells = [(f"{100.0 * one[loss][0]:.1f} %", f"{one[loss][1] / one['none'][1]:.2f}") for one in found]
        table.add_row(loss, *(text for pair in cells for text in pair))
    console.print(table)


if __name__ == "__main__":
    main()
