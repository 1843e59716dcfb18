"""False alarms, delays and classification of the change detector, for simulated years and changes.

    python -m tests.experiments.benchmarks.changes [rate false delays steps loss cost] [--years 0.3]

All alarms are alarms of the real detector on complete sample series. The 95 % intervals of counts are Poisson intervals
(Garwood), and those of shares use √(p(1 − p)/n). A delay is the time from the onset to the alarm. The event is
published after twice the delay (at least 256 samples more), when the size of the change has been measured.
"""

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.stats import chi2

from drivers.data_types import AXES, Floats
from monitor.estimation.allan.batch import cluster_sizes
from monitor.estimation.allan.window import AllanWindow
from monitor.estimation.detection.change_detection import NOISE_SHARE, RATE_AT_ZERO, Change, NoiseAndBiasChangeDetector
from monitor.noise.effects.ieee952.angle_random_walk import AngleRandomWalk
from monitor.noise.effects.ieee952.bias_instability import BiasInstability
from monitor.noise.effects.ieee952.quantization_noise import QuantizationNoise
from monitor.noise.effects.ieee952.rate_random_walk import RateRandomWalk
from monitor.noise.model import NoiseModel
from tests.experiments.benchmarks.machine import Load, console, create_table, describe_machine, time_alternately

WHITE: Final = 1.5e-4
RESOLUTION: Final = np.deg2rad(0.05)
BLOCK_SAMPLES: Final = 100_000
RATE_HZ: Final = 100.0


def draw_loss(share: float, length: int = 1) -> Callable[[int, np.random.Generator], NDArray[np.bool_]]:
    """Return a function that returns a mask [n], which is True for a share of the samples in bursts of a length."""

    def lose(n: int, rng: np.random.Generator) -> NDArray[np.bool_]:
        begins = rng.random(n) < 1.0 - (1.0 - share) ** (1.0 / length)
        return np.convolve(begins, np.ones(length))[:n] > 0.0

    return lose


LOSSES: Final = {
    "none": draw_loss(0.0),
    "1 % at random": draw_loss(0.01),
    "5 % at random": draw_loss(0.05),
    "20 % at random": draw_loss(0.2),
    "10 % in bursts of 10": draw_loss(0.1, 10),
    "10 % in bursts of 300": draw_loss(0.1, 300),
}


def make_mems_mix(k: float = 1.5e-6) -> NoiseModel:
    """Return a model with six equal axes of a MEMS gyro."""
    sources = (
        QuantizationNoise(Q=2e-6), AngleRandomWalk(N=WHITE), BiasInstability(B=4e-5), RateRandomWalk(K=k),
    )  # fmt: skip
    return NoiseModel(dict.fromkeys(AXES, sources))


def draw_white(rate_hz: float, seed: int) -> Callable[[int], Floats]:
    """Return a function that draws white noise with N = WHITE."""
    rng = np.random.default_rng(seed)
    return lambda n: WHITE * rate_hz**0.5 * rng.standard_normal((n, 6))


def draw_coarse(rate_hz: float, seed: int) -> Callable[[int], Floats]:
    """Return a function that draws the MEMS mix with a resolution of 0.05 °/s (0.58 σ at 100 Hz, 1.8 σ at 10 Hz)."""
    draw = make_mems_mix().start_stream(rate_hz, seed).draw_next_samples
    return lambda n: np.asarray(np.round(draw(n) / RESOLUTION) * RESOLUTION)


def poisson_interval(count: int) -> tuple[float, float]:
    """Return the 95 % interval of the mean of a count."""
    low = 0.5 * float(chi2.ppf(0.025, 2 * count)) if count else 0.0
    return low, 0.5 * float(chi2.ppf(0.975, 2 * count + 2))


def print_rate_constant(seed: int) -> None:
    """Print the alarms per z² at low thresholds times e^h, which is the constant RATE_AT_ZERO."""
    table = create_table(
        "white noise, six axes: alarms of noise at thresholds low enough to count",
        "h",
        "alarms",
        "z²",
        "alarms/z² · e^h",
    )
    for h in (8.0, 9.0, 10.0, 11.0, 12.0):
        # a rate of 1 Hz only sets the learning time before an alarm, which is 64 terms
        detector = NoiseAndBiasChangeDetector(1.0, 86_400.0 * 6 * RATE_AT_ZERO / (NOISE_SHARE * np.exp(h)))
        draw, n = draw_white(1.0, seed), 0
        kinds: Counter[str] = Counter()
        while n < 10_000_000:
            detector.process_samples(draw(BLOCK_SAMPLES))
            n += BLOCK_SAMPLES
            kinds.update(change.kind for change in detector.take_changes())
        count, scale = kinds["noise_changed"], np.exp(h) / (6 * n)
        low, high = poisson_interval(count)
        table.add_row(
            f"{h:g}", f"{count}", f"{6 * n:.1e}", f"{count * scale:.3f} ({low * scale:.3f}–{high * scale:.3f})"
        )
    console.print(table)


def print_false_alarms(years: float, seed: int) -> None:
    """Print the alarms on constant noise for several stated rates."""
    table = create_table(
        "constant noise, six axes", "noise", "simulated", "stated per day", "alarms", "per day", "kinds",
    )  # fmt: skip
    day = 86_400.0
    cases: list[tuple[str, float, float, Callable[[int], Floats]]] = [
        ("white, 10 Hz", 10.0, years * 365.25, draw_white(10.0, seed)),
        ("MEMS mix, 10 Hz", 10.0, years * 365.25 / 3, make_mems_mix().start_stream(10.0, seed).draw_next_samples),
        ("mix at 0.05 °/s, 10 Hz", 10.0, years * 365.25 / 3, draw_coarse(10.0, seed)),
        ("MEMS mix, 100 Hz", 100.0, years * 365.25 / 30, make_mems_mix().start_stream(100.0, seed).draw_next_samples),
    ]
    for title, rate_hz, days, draw in cases:
        detectors = [NoiseAndBiasChangeDetector(rate_hz, stated) for stated in (1 / 30, 1.0, 10.0)]
        kinds: list[Counter[str]] = [Counter() for _ in detectors]
        for _ in range(int(days * day * rate_hz / BLOCK_SAMPLES)):
            values = draw(BLOCK_SAMPLES)
            for detector, seen in zip(detectors, kinds, strict=True):
                detector.process_samples(values)
                seen.update(change.kind for change in detector.take_changes())
        for stated, seen in zip((1 / 30, 1.0, 10.0), kinds, strict=True):
            low, high = poisson_interval(seen.total())
            rate = f"{seen.total() / days:.3f} ({low / days:.3f}–{high / days:.3f})"
            table.add_row(title, f"{days:.1f} d", f"{stated:.3f}", f"{seen.total()}", rate, str(dict(seen)))
    console.print(table)


def make_changes() -> dict[str, tuple[float, float, Callable[[Floats, np.random.Generator], Floats]]]:
    """Return for each change the seconds before and after its onset, and a function that changes the samples [n, 6]."""
    sigma = WHITE * RATE_HZ**0.5

    def add_noise(factor: float) -> Callable[[Floats, np.random.Generator], Floats]:
        extra = sigma * (factor**2 - 1.0) ** 0.5
        return lambda values, rng: values + extra * rng.standard_normal(values.shape)

    def resonance(values: Floats, rng: np.random.Generator) -> Floats:
        # poles at 20 Hz, 1 Hz wide
        r, angle = np.exp(-np.pi * 1.0 / RATE_HZ), 2.0 * np.pi * 20.0 / RATE_HZ
        made = lfilter(
            [1.0], [1.0, -2.0 * r * np.cos(angle), r * r], rng.standard_normal((len(values) + 1000, 6)), axis=0
        )
        return np.asarray(values + 0.5 * sigma * (made / made.std(0))[1000:])

    def low_pass(values: Floats, rng: np.random.Generator) -> Floats:
        # one pole at 15 Hz
        p = np.exp(-2.0 * np.pi * 15.0 / RATE_HZ)
        start = (p * values[0])[None]
        return np.asarray(lfilter([1.0 - p], [1.0, -p], values, axis=0, zi=start)[0])

    return {
        "N × 1.5": (600.0, 120.0, add_noise(1.5)),
        "N × 1.2": (600.0, 240.0, add_noise(1.2)),
        "N × 1.1": (600.0, 600.0, add_noise(1.1)),
        "resonance, σ/2 at 20 Hz": (600.0, 240.0, resonance),
        "low-pass at 15 Hz": (600.0, 120.0, low_pass),
    }


def detect_first_changes(first: Floats, second: Floats) -> Iterator[list[Change]]:
    """Yield the first detected change on each axis without an alarm in the first series."""
    detector = NoiseAndBiasChangeDetector(RATE_HZ)
    detector.process_samples(first)
    false_axes = {change.axis for change in detector.take_changes()}
    detector.process_samples(second)
    found = detector.take_changes()
    for axis in range(6):
        if axis not in false_axes:
            yield [change for change in found if change.axis == axis][:1]


def format_row(title: str, results: list[list[Change]], onset: int, rate_hz: float = RATE_HZ) -> tuple[str, ...]:
    """Return a row with the share of detected changes, delay, error of the onset, and classification."""
    found = [changes[0] for changes in results if changes and changes[0].found > onset]
    if not found:
        return (title, f"0 of {len(results)}", "–", "–", "–")
    delays = np.array([change.found - onset for change in found]) / rate_hz
    errors = np.array([change.since - onset for change in found]) / rate_hz
    names = Counter(
        change.kind if change.kind != "noise_changed" else "".join(k for k in change.what if k != "rms")
        for change in found
    )
    classes = ", ".join(f"{name or 'nothing'} {count}" for name, count in names.most_common())
    low, high = np.percentile(errors, [10, 90])
    return (
        title, f"{len(found)} of {len(results)}", f"{np.median(delays):.2f}, {np.percentile(delays, 90):.2f}",
        f"{np.median(errors):+.2f} ({low:+.2f} … {high:+.2f})", classes,
    )  # fmt: skip


def print_delays(repeats: int, seed: int) -> None:
    """Print delay, onset error and classification of changes of the mix at 100 Hz."""
    table = create_table(
        "changes of the MEMS mix at 100 Hz, one false alarm in 30 days", "change", "found",
        "delay s: median, 90 %", "onset error s: median (10–90 %)", "named",
    )  # fmt: skip
    for title, (before, after, change) in make_changes().items():
        results: list[list[Change]] = []
        for k in range(-(-repeats // 6)):
            values = make_mems_mix().simulate(int((before + after) * RATE_HZ), RATE_HZ, seed + k)
            cut = int(before * RATE_HZ)
            results += detect_first_changes(values[:cut], change(values[cut:], np.random.default_rng(seed + k)))
        table.add_row(*format_row(title, results, int(before * RATE_HZ)))
    results = []
    for k in range(-(-repeats // 24)):  # K × 3 needs days, so the rate is 10 Hz, with the same K
        slow = NoiseAndBiasChangeDetector(10.0)
        cut, n = 2 * 864_000, 864_000
        slow.process_samples(make_mems_mix().simulate(cut, 10.0, seed + k))
        false_axes = {change.axis for change in slow.take_changes()}
        slow.process_samples(make_mems_mix(4.5e-6).simulate(n, 10.0, seed + 1000 + k))
        found = [c for c in slow.take_changes() if c.kind != "bias_stepped"]
        results += [[c for c in found if c.axis == axis][:1] for axis in range(6) if axis not in false_axes]
    text = format_row("K × 3 after 2 days, 10 Hz", results, cut, 10.0)
    table.add_row(*text)
    console.print(table)


def print_steps(repeats: int, seed: int) -> None:
    """Print the detection of bias steps after an hour, in units of the white σ."""
    table = create_table(
        "steps of the bias, MEMS mix at 100 Hz, after an hour, watched for ten minutes", "height / σ", "found",
        "delay s: median, 90 %", "onset error s: median (10–90 %)", "named",
    )  # fmt: skip
    for height in (10.0, 3.0, 1.0, 0.5, 0.2):
        results: list[list[Change]] = []
        for k in range(-(-repeats // 24)):
            values = make_mems_mix().simulate(420_000, RATE_HZ, seed + k)
            cut = 360_007  # not at the border of a block
            values[cut:] += height * WHITE * RATE_HZ**0.5
            results += detect_first_changes(values[:cut], values[cut:])
        table.add_row(*format_row(f"{height:g}", results, 360_007))
    console.print(table)


def print_loss(days: float, repeats: int, seed: int) -> None:
    """Print delays at 100 Hz and false alarms at 10 Hz, if samples of the mix are missing on all axes."""
    changes, step = make_changes(), WHITE * RATE_HZ**0.5
    cases = {"N × 1.5": changes["N × 1.5"], "N × 1.2": changes["N × 1.2"]}
    cases["step of 1 σ"] = (1200.0, 60.0, lambda values, _: values + step)
    table = create_table(
        f"MEMS mix: found of {repeats}, delay s (median, 90 %); alarms in {days:g} d",
        "loss",
        *cases,
        "alarms at 1 a day",
    )
    cells: dict[str, list[str]] = {loss: [] for loss in LOSSES}
    for before, after, change in cases.values():
        results: dict[str, list[list[Change]]] = {loss: [] for loss in LOSSES}
        cut = int(before * RATE_HZ) + 7  # not at the border of a block
        for k in range(-(-repeats // 6)):
            values = make_mems_mix().simulate(cut + int(after * RATE_HZ), RATE_HZ, seed + k)
            values[cut:] = change(values[cut:], np.random.default_rng(seed + k))
            for loss, lose in LOSSES.items():
                kept = np.where(lose(len(values), np.random.default_rng(seed + k))[:, None], np.nan, values)
                results[loss] += detect_first_changes(kept[:cut], kept[cut:])
        for loss, found in results.items():
            _, count, delay, *_ = format_row("", found, cut)
            cells[loss].append(f"{count.split()[0]}: {delay}")
    detectors = {loss: NoiseAndBiasChangeDetector(10.0, 1.0) for loss in LOSSES}
    rng, draw = np.random.default_rng(seed), make_mems_mix().start_stream(10.0, seed).draw_next_samples
    seen: Counter[str] = Counter()
    for _ in range(int(days * 864_000 / BLOCK_SAMPLES)):
        values = draw(BLOCK_SAMPLES)
        for loss, lose in LOSSES.items():
            detectors[loss].process_samples(np.where(lose(BLOCK_SAMPLES, rng)[:, None], np.nan, values))
            seen[loss] += len(detectors[loss].take_changes())
    for loss, texts in cells.items():
        table.add_row(loss, *texts, f"{seen[loss]}")
    console.print(table)


def print_cost() -> None:
    """Print the processor time compared with AllanWindow, in blocks of 100 samples."""
    values = draw_white(RATE_HZ, 0)(100_000)
    detector, window = NoiseAndBiasChangeDetector(RATE_HZ), AllanWindow(100_000, cluster_sizes(100_000, RATE_HZ))

    def run(update: Callable[[Floats], None]) -> Callable[[], None]:
        def work() -> None:
            for start in range(0, len(values), 100):
                update(values[start : start + 100])

        return work

    run(detector.process_samples)(), run(window.append_samples)()
    load = Load()
    took = time_alternately({"change": run(detector.process_samples), "window": run(window.append_samples)}, 7)
    table = create_table("cost, six axes, blocks of 100", "what", "ns a sample and axis: median (best)")
    for name, (median, best) in took.items():
        table.add_row(name, f"{median / 6e5 * 1e9:.1f} ({best / 6e5 * 1e9:.1f})")
    console.print(table)
    console.print(load.describe())


def main() -> None:
    """Run the requested parts, or all parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("parts", nargs="*", default=["rate", "false", "delays", "steps", "loss", "cost"])
    parser.add_argument("--years", type=float, default=0.3)
    parser.add_argument("--repeats", type=int, default=120)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    console.print(describe_machine())
    parts: dict[str, Callable[[], None]] = {
        "rate": lambda: print_rate_constant(arguments.seed),
        "false": lambda: print_false_alarms(arguments.years, arguments.seed),
        "delays": lambda: print_delays(arguments.repeats, arguments.seed),
        "steps": lambda: print_steps(arguments.repeats, arguments.seed),
        "loss": lambda: print_loss(100.0 * arguments.years / 0.3, arguments.repeats, arguments.seed),
        "cost": print_cost,
    }
    for part in arguments.parts:
        begun = time.process_time()
        parts[part]()
        console.print(f"{part}: {time.process_time() - begun:.0f} s of one core\n")


if __name__ == "__main__":
    main()
