"""Do the intervals hold what they promise? Simulates records of known noise and counts.

    python tests/bench/coverage.py --records 300 --seconds 2700

For the mix of a MEMS gyro (Q 2e-6, N 1.5e-4, B 4e-5, K 1.5e-6 at 100 Hz) it prints how often the 95 %
intervals of deviations and of coefficients hold the truth, the rms error of the fit over the
Cramér–Rao limit of the spectrum (Whittle), and how often a term that was left out of the simulation
enters all the same. Counting errors of a share p over n looks are √(p(1 − p)/n).
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from drivers.sample import AXES, Floats
from monitor.estimate.batch import cluster_sizes, overlapping
from monitor.estimate.coefficients import LETTERS, Status
from monitor.estimate.fit import Fit, design, fit, slope_of_thirds
from monitor.estimate.uncertainty import intervals, table
from monitor.noise.effect import Source
from monitor.noise.effects.angle_random_walk import AngleRandomWalk
from monitor.noise.effects.bias_instability import BiasInstability
from monitor.noise.effects.quantization_noise import QuantizationNoise
from monitor.noise.effects.rate_ramp import RateRamp
from monitor.noise.effects.rate_random_walk import RateRandomWalk
from monitor.noise.model import NoiseModel

RATE_HZ = 100.0
MIX: dict[str, Source] = {
    "Q": QuantizationNoise(Q=2e-6),
    "N": AngleRandomWalk(N=1.5e-4),
    "B": BiasInstability(B=4e-5),
    "K": RateRandomWalk(K=1.5e-6),
}


@dataclass(frozen=True, slots=True)
class Look:
    """One record of six equal axes, fitted."""

    avar: Floats  # [m, 6]
    fit: Fit


def looks(sources: tuple[Source, ...], n: int, records: int, seed: int) -> Iterator[Look]:
    """Fits of simulated records, six at a time."""
    factors = cluster_sizes(n, RATE_HZ)
    columns, covariances = design(factors, RATE_HZ), table(n, factors)
    model = NoiseModel(dict.fromkeys(AXES, sources))
    for k in range(-(-records // len(AXES))):
        values = model.simulate(n, RATE_HZ, seed + k)
        avar, terms = overlapping(values, factors)
        thirds = np.cumsum(values, axis=0)[[0, n // 3, 2 * n // 3, n - 1]] / RATE_HZ
        slope = slope_of_thirds(thirds, n / RATE_HZ)
        yield Look(avar, fit(columns, covariances, avar, terms, slope=slope))


def true_values(sources: tuple[Source, ...]) -> Floats:
    """Q N B K R of a list of sources; zero where there is none."""
    return np.array([next((getattr(s, c) for s in sources if hasattr(s, c)), 0.0) for c in LETTERS])


def cramer_rao(sources: tuple[Source, ...], n: int) -> Floats:
    """Least relative standard deviation of the coefficients of ``sources``, from Whittle's information.

    I_ab = Σ_k S_a S_b / S² over the n/2 positive frequencies, in the variances; half of it in deviations.
    """
    f = np.arange(1, n // 2, dtype=np.float64) * (RATE_HZ / n)
    spectra = np.stack([source.psd(f, 1.0 / RATE_HZ) for source in sources])
    shares = spectra / spectra.sum(0)
    return np.asarray(0.5 * np.sqrt(np.diag(np.linalg.inv(shares @ shares.T))))


def held(looked: list[Look], truth: Floats) -> None:
    """Print coverage and power of the coefficients."""
    for row, letter in enumerate(LETTERS):
        status = np.concatenate([look.fit.coefficients.status[row] for look in looked])
        lo = np.concatenate([look.fit.coefficients.lo[row] for look in looked])
        hi = np.concatenate([look.fit.coefficients.hi[row] for look in looked])
        within = (lo <= truth[row]) & (truth[row] <= hi)
        estimated, bounded = status == Status.ESTIMATED, status == Status.UPPER_BOUND
        print(
            f"  {letter}: in {estimated.mean():6.1%}, holds when in {_share(within[estimated])}, "
            f"bound holds {_share(within[bounded])}, both {_share(within[status != Status.UNESTIMATED])}, "
            f"median bound {np.median(hi[bounded]) if bounded.any() else np.nan:.2g}"
        )


def deviations(looked: list[Look], sources: tuple[Source, ...], n: int) -> None:
    """Print coverage of the intervals of the deviations, one by one and for m ≤ n/8."""
    factors = cluster_sizes(n, RATE_HZ)
    truth = sum(source.avar(factors / RATE_HZ, 1.0 / RATE_HZ) for source in sources)
    inside = []
    for look in looked:
        lo, hi = intervals(look.avar, look.fit.edf)
        inside.append((truth >= lo.T**2) & (truth <= hi.T**2))
    share = np.concatenate(inside)
    print("  deviations, m ≤ n/8:", _share(share[:, factors <= n // 8].ravel()))
    print("  by τ:", " ".join(f"{s:.3f}" for s in share.mean(0)))


def errors(looked: list[Look], sources: tuple[Source, ...], n: int) -> None:
    """Print rms relative error of √θ over the Cramér–Rao limit, whether or not a term is in."""
    theta = np.concatenate([look.fit.theta.T for look in looked])
    limit = cramer_rao(sources, n)
    for k, (letter, source) in enumerate(zip("QNBK", sources, strict=False)):
        relative = np.sqrt(np.maximum(theta[:, k], 0.0)) / getattr(source, letter) - 1.0
        print(f"  {letter}: rms {np.sqrt(np.mean(relative**2)):.4f}, limit {limit[k]:.4f}, "
              f"ratio {np.sqrt(np.mean(relative**2)) / limit[k]:.2f}, mean {relative.mean():+.4f}")  # fmt: skip


def _share(flags: np.ndarray) -> str:
    return f"{flags.mean():.3f} of {flags.size}" if flags.size else "–"


def main() -> None:
    """Run all counts for one length of record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--records", type=int, default=300)
    parser.add_argument("--seconds", type=float, default=2700.0)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    n = int(given.seconds * RATE_HZ)
    cases = {"whole mix": tuple(MIX.values())}
    cases |= {f"without {c}": tuple(s for k, s in MIX.items() if k != c) for c in "QBK"}
    cases["K × 10"] = (*(MIX[c] for c in "QNB"), RateRandomWalk(K=1.5e-5))
    for ramp in (2e-7, 1e-6):
        cases[f"with a ramp of {ramp}"] = (*MIX.values(), RateRamp(R=ramp))
    for title, sources in cases.items():
        print(title)
        looked = list(looks(sources, n, given.records, given.seed))
        held(looked, true_values(sources))
        deviations(looked, sources, n)
        if len(sources) == 4:
            errors(looked, sources, n)


if __name__ == "__main__":
    main()
