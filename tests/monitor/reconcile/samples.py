"""Reconciliations made by hand, for everything that writes, draws or prints them: nothing here was found by a search.

``explained`` is a gyroscope with a line at 17.3 Hz on z and more white noise than its model says, ``unexplained`` has
a hump that no effect makes. Spectra and Allan deviations are what such noise has, with the scatter that an hour leaves.
"""

from dataclasses import replace

import numpy as np

from drivers.data_types import AXES, Floats
from monitor.noise.effects import AngleRandomWalk, BiasInstability, RateRandomWalk, Sinusoidal
from monitor.noise.model import NoiseModel
from monitor.reconcile.result import (
    AddedOrResizedEffect,
    AllanInfluence,
    AlternativeEffect,
    AxisModelDiagnostics,
    AxisResult,
    DiagnosticGap,
    DiagnosticPlotData,
    Location,
    ParameterInterval,
    Reconciliation,
    RemainingGap,
)

RATE_HZ, SECONDS = 100.0, 3600.0
N, B, K = 1.5e-4, 4.0e-5, 1.5e-6  # rad/√s, rad/s, rad/s/√s
MORE_N = 1.8e-4  # what z really has
A, LINE_HZ = 1.5e-4, 17.3  # rad/s, Hz
ACCELEROMETER = 6.0  # times as much of everything, in m/s²


def spectrum(f_hz: Floats, n: float) -> Floats:
    """Return the two-sided spectrum of white noise, flicker and random walk (IEEE Std 952, annex B)."""
    return n**2 + B**2 / (2 * np.pi * f_hz) + K**2 / (2 * np.pi * f_hz) ** 2


def avar(tau_s: Floats, n: float) -> Floats:
    """Return the Allan variance of the same terms."""
    return n**2 / tau_s + 2 * np.log(2) / np.pi * B**2 + K**2 * tau_s / 3


def line_avar(tau_s: Floats, amplitude: float = A) -> Floats:
    """Return the Allan variance of a continuous sinusoid."""
    at = np.pi * LINE_HZ * tau_s
    return amplitude**2 * np.sin(at) ** 4 / at**2


def look(
    axis: str,
    n_model: float = N,
    n_true: float = N,
    line: bool = False,
    known_line: bool = False,
    hump: bool = False,
) -> AxisModelDiagnostics:
    """Return plot data of four diagnostics. ``line`` is in the data, ``known_line`` also in the model."""
    rng = np.random.default_rng(AXES.index(axis))  # the same measurement beside every model
    size = 1.0 if axis.startswith("g") else ACCELEROMETER
    views = (
        _psd(axis, rng, size, n_model, n_true, line, known_line, hump),
        _allan(axis, rng, size, n_model, n_true, line, known_line),
        _level(axis, rng, size),
        _distribution(rng, n_true / n_model),
    )
    off = abs(n_true / n_model - 1) * 40
    peak = Location(frequency=(17.1, 17.5)) if line and not known_line else Location(frequency=(6.0, 11.0))
    psd = 41.2 if line and not known_line else 7.9 if hump else 0.6 + off / 2
    scores = (
        DiagnosticGap("psd", peak, psd, 1.9, 2.6),
        DiagnosticGap("allan", Location(tau=(0.01, 0.64)), 0.7 + off, 1.6, 2.4),
        DiagnosticGap("level", Location(time=(1200.0, 1320.0)), 1.1, 1.7, 2.5),
        DiagnosticGap("distribution", Location(), 0.4 + off / 9, 1.8, 2.7),
        DiagnosticGap("other_axes", Location(source="ax" if axis != "ax" else "gx"), 0.2, 1.5, 2.5),
    )
    return AxisModelDiagnostics(scores, views)


def agrees(fitted_first: bool = False) -> Reconciliation:
    """Return the result of six axes that agree with the model."""
    axes = {a: AxisResult(a, "agrees", look(a), (), (), look(a)) for a in AXES}
    model = NoiseModel(dict.fromkeys(axes, _terms()), sample_rate_hz=RATE_HZ)
    return Reconciliation("agrees", axes, model, model, fitted_first, RATE_HZ, 360_000, SECONDS, 7)


def explained() -> Reconciliation:
    """Return a result with two steps on gz: a new line and a changed white-noise level."""
    start = look("gz", n_true=MORE_N, line=True)
    with_line = look("gz", n_true=MORE_N, line=True, known_line=True)
    with_all = look("gz", n_model=MORE_N, n_true=MORE_N, line=True, known_line=True)
    line = AddedOrResizedEffect(
        kind="added",
        effect="sinusoidal",
        parameters={
            "amplitude": ParameterInterval(1.5e-4, 1.474e-4, 1.526e-4),
            "frequency": ParameterInterval(17.300012, 17.299912, 17.300112),
        },
        confidence=0.9983,
        runners_up=(AlternativeEffect("narrowband", 0.0016), AlternativeEffect("sample_rate_error", 0.0001)),
        before=start.gaps[0],
        after=with_line.gaps[0],
        held_out=(39.7, 1.0),
        held_out_reason="",
        because="One bin of 0.28 mHz at 17.3 Hz holds 41 times what the model expects there, and its phase holds "
        "from the first minute to the last; a resonance would be at least 1 mHz wide.",
        snapshot_after=with_line,
        gain_nats=848.0,
        allan=AllanInfluence(1.05, 0.02),
    )
    white = AddedOrResizedEffect(
        kind="retuned",
        effect="angle_random_walk",
        parameters={"N": ParameterInterval(MORE_N, 1.7958e-4, 1.8042e-4)},
        confidence=0.99996,
        runners_up=(),
        before=with_line.gaps[1],
        after=with_all.gaps[1],
        held_out=None,
        held_out_reason="a known term of another size is not held out",
        because="From 0.01 s to 0.6 s the Allan deviation is higher by one factor, 1.20, with white noise's slope.",
        snapshot_after=with_all,
        gain_nats=38.0,
        allan=AllanInfluence(1.2, 0.01),
    )
    whole = agrees()
    axes = {**whole.axes, "gz": AxisResult("gz", "explained", start, (line, white), (), white.snapshot_after)}
    found = (AngleRandomWalk(N=MORE_N), *_terms()[1:], Sinusoidal(amplitude=1.5e-4, frequency=17.300012))
    return replace(
        whole,
        verdict="explained",
        axes=axes,
        model=NoiseModel({**whole.baseline.effects, "gz": found}, sample_rate_hz=RATE_HZ),
        notes=("12 missing samples <in 1 gap> & filled",),
    )


def partly_explained() -> Reconciliation:
    """Return a result with the line of ``explained``, but without the step of the white noise."""
    whole = explained()
    gz = whole.axes["gz"]
    left = tuple(score for score in gz.steps[0].snapshot_after.gaps if score.is_significant)
    remaining = (RemainingGap("spectrum", left[0], 38.0),)
    result = replace(gz, verdict="partly_explained", steps=gz.steps[:1], left_over=left, remaining=remaining)
    return replace(whole, verdict="partly_explained", axes={**whole.axes, "gz": result})


def unexplained() -> Reconciliation:
    """Return a result with an unexplained hump in the spectrum of one accelerometer."""
    start = look("ax", hump=True)
    remaining = (RemainingGap("spectrum", start.gaps[0], 31.2),)
    result = AxisResult("ax", "unexplained", start, (), (start.gaps[0],), start, remaining)
    model = NoiseModel({"ax": _terms()}, sample_rate_hz=RATE_HZ)
    return Reconciliation("unexplained", {"ax": result}, model, model, True, RATE_HZ, 360_000, SECONDS, 7)


def _terms() -> tuple[AngleRandomWalk, BiasInstability, RateRandomWalk]:
    return AngleRandomWalk(N=N), BiasInstability(B=B), RateRandomWalk(K=K)


def _psd(
    axis: str,
    rng: np.random.Generator,
    size: float,
    n_model: float,
    n_true: float,
    line: bool,
    known_line: bool,
    hump: bool,
) -> DiagnosticPlotData:
    """Return bins of a cosine transform: 48 single coefficients, then 16 per octave, at most 0.1 Hz wide."""
    single = np.arange(1, 49) / (2 * SECONDS)
    edges = [float(single[-1])]
    while edges[-1] < RATE_HZ / 2:
        edges.append(min(edges[-1] + min(0.1, edges[-1] * (2 ** (1 / 16) - 1)), RATE_HZ / 2))
    f = np.concatenate([single, np.sqrt(np.array(edges[1:]) * edges[:-1])])
    count = np.concatenate([np.ones(48), np.maximum(np.round(np.diff(edges) * 2 * SECONDS), 1)])
    density = A**2 / 4 / 0.1 * (np.abs(f - LINE_HZ) < 0.05)  # a two-sided line in a bin 0.1 Hz wide
    truth = spectrum(f, n_true) + line * density
    truth = truth * (1 + 0.5 * hump * np.exp(-0.5 * (np.log(f / 8.0) / 0.15) ** 2))
    expected = spectrum(f, n_model) + known_line * density
    spread = 1.96 * np.sqrt(2 / count)
    return DiagnosticPlotData(
        "psd", "frequency", "Hz", "spectral density", "(rad/s)²/Hz" if axis.startswith("g") else "(m/s²)²/Hz", True, f,
        size**2 * truth * rng.chisquare(count) / count,
        size**2 * expected, size**2 * expected * np.exp(-spread), size**2 * expected * np.exp(0.7 * spread),
    )  # fmt: skip


def _allan(
    axis: str, rng: np.random.Generator, size: float, n_model: float, n_true: float, line: bool, known_line: bool
) -> DiagnosticPlotData:
    tau = 2.0 ** np.arange(17) / RATE_HZ
    edf = 1.5 * SECONDS / tau
    expected = size * np.sqrt(avar(tau, n_model) + known_line * line_avar(tau))
    measured = size * np.sqrt((avar(tau, n_true) + line * line_avar(tau)) * rng.chisquare(edf) / edf)
    spread = np.exp(0.98 * np.sqrt(2 / edf))
    unit = "rad/s" if axis.startswith("g") else "m/s²"
    return DiagnosticPlotData(
        "allan", "averaging time", "s", "Allan deviation", unit, True, tau, measured,
        expected, expected / spread, expected * spread,
    )  # fmt: skip


def _level(axis: str, rng: np.random.Generator, size: float) -> DiagnosticPlotData:
    """Return means of 10 s."""
    t = np.arange(5.0, SECONDS, 10.0)
    sigma = size * np.sqrt(avar(np.array([10.0]), N)[0] + K**2 * 300)
    measured = sigma * rng.standard_normal(t.size)
    unit = "rad/s" if axis.startswith("g") else "m/s²"
    half = 1.96 * sigma * np.ones_like(t)
    return DiagnosticPlotData("level", "time", "s", "mean of 10 s", unit, False, t, measured, 0 * t, -half, half)


def _distribution(rng: np.random.Generator, ratio: float) -> DiagnosticPlotData:
    """Return the density of the whitened samples."""
    x = np.linspace(-4.5, 4.5, 73)
    expected = np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi)
    truth = np.exp(-0.5 * (x / ratio) ** 2) / np.sqrt(2 * np.pi) / ratio
    sigma = np.sqrt(expected / 360_000 / (x[1] - x[0]))
    measured = np.maximum(truth + sigma * rng.standard_normal(x.size), 0.0)
    return DiagnosticPlotData(
        "distribution", "value over its deviation", "1", "density", "1", False, x, measured,
        expected, np.maximum(expected - 1.96 * sigma, 0.0), expected + 1.96 * sigma,
    )  # fmt: skip
