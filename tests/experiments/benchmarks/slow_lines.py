"""Measure which share of the samples counts as motion beside a slow sinusoid that does not change.

python -m tests.experiments.benchmarks.slow_lines
"""

from typing import Final

import numpy as np

from monitor.estimation.detection.motion_detection import detect_motion

RATE_HZ: Final = 100.0
SECONDS, BEGIN_S, SETTLED_S = 600, 60, 140
SIZES: Final = (3.0, 6.0, 10.0, 20.0, 50.0)
TRIALS: Final = 6
NOISE: Final = np.array([1e-3] * 3 + [1e-2] * 3)


def simulate(frequency_hz: float, size: float, begin_s: int, seed: int) -> np.ndarray:
    """Return white noise with a sinusoid on gz from ``begin_s``, whose amplitude is ``size`` standard deviations."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(SECONDS * RATE_HZ)) / RATE_HZ
    values = NOISE * rng.standard_normal((t.size, 6))
    line = np.sin(2 * np.pi * frequency_hz * t + rng.uniform(0.0, 2 * np.pi))
    values[:, 2] += size * NOISE[2] * line * (t >= begin_s)
    return values


def main() -> None:
    """Print the shares in percent for lines from the start, and for lines that began at least 80 s before."""
    for begin_s in (0, BEGIN_S):
        after = slice(round((begin_s and SETTLED_S) * RATE_HZ), None)
        print(f"from {begin_s} s; sizes {', '.join(f'{size:g}' for size in SIZES)}")
        for frequency_hz in (0.03, 0.1, 0.2, 0.3, 0.5, 0.7, 1.3):
            shares = [
                np.mean(
                    [
                        detect_motion(simulate(frequency_hz, size, begin_s, seed), RATE_HZ)[0][after].mean()
                        for seed in range(TRIALS)
                    ]
                )
                for size in SIZES
            ]
            print(f"{frequency_hz:4g} Hz", *(f"{100 * share:5.1f}" for share in shares), flush=True)


if __name__ == "__main__":
    main()
