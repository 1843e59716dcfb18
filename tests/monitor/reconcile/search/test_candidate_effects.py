"""Tests that each family of candidates finds the hidden effect and proposes no effect that cannot be tested."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from drivers.data_types import AXES
from monitor.noise.effects import (
    EFFECTS,
    BandwidthLimit,
    BiasStep,
    CrossAxis,
    ExponentiallyCorrelated,
    GSensitivity,
    Narrowband,
    PowerLaw,
    QuantizationNoise,
    RateRamp,
    Sinusoidal,
    TemperatureBias,
    TemperatureHysteresis,
    TemperatureLag,
    TurnOnTransient,
)
from monitor.noise.model import NoiseModel
from monitor.noise.spectrum import white_noise_spectrum
from monitor.reconcile.effect_properties import PENALTY_NATS
from monitor.reconcile.likelihood.effect_roles import build_unit_regressors
from monitor.reconcile.search import candidate_effects as propose
from monitor.reconcile.search.candidate_effects import _line_frequency, find_broad_spectral_peaks
from tests.monitor.reconcile.axes import (
    RATE_HZ,
    TERMS,
    WALK,
    WHITE,
    N,
    axes,
    axis,
    correlated,
    draw_resonance,
    make_temperature,
    time_s,
    walk,
    white,
    whiten,
)

n = 24_000
MODEL = (WHITE, WALK)


def draw_noise(seed=0):
    rng = np.random.default_rng(seed)
    return white(n, rng) + walk(n, rng)


def list_candidates(family, one, model=MODEL):
    """Return the candidates of a family by name."""
    return {effect.name: effect for effect in family(whiten(one, model))}


def test_every_effect_has_a_complexity_penalty():
    # a mean is always free; the clock, the unit and the order of the axes are asked for all axes together
    common = {"bias", "sample_rate_error", "unit_error", "axis_permutation"}
    assert set(PENALTY_NATS) == set(EFFECTS) - common
    assert min(PENALTY_NATS.values()) > 0.0


def test_missing_noise_terms_are_proposed():
    assert set(list_candidates(propose.propose_allan_terms, axis(draw_noise()))) == {
        "quantization_noise",
        "bias_instability",
    }
    assert set(list_candidates(propose.propose_allan_terms, axis(draw_noise()), TERMS)) == {"quantization_noise"}
    model = (QuantizationNoise(Q=1e-8), *TERMS)
    assert list_candidates(propose.propose_allan_terms, axis(draw_noise()), model) == {}


@pytest.mark.parametrize(("q_relative", "proposed"), [(0.0, False), (0.3, False), (0.8, True)])
def test_quantization_noise_beside_a_low_pass_filter_is_proposed_only_if_the_spectrum_rises(q_relative, proposed):
    rng = np.random.default_rng(2)
    low_pass = BandwidthLimit(cutoff=0.2 * RATE_HZ, order=1)
    filtered = NoiseModel({"gz": (WHITE, low_pass)}).simulate(n, RATE_HZ, 2)[:, AXES.index("gz")]
    increments = np.diff(rng.standard_normal(n + 1))
    y = filtered + 0.3 * white(n, rng) + q_relative * N * RATE_HZ**0.5 * increments
    found = list_candidates(propose.propose_allan_terms, axis(y), (WHITE, WALK, low_pass))
    assert ("quantization_noise" in found) == proposed


@pytest.mark.parametrize("correlation_s", [0.05, 0.5, 5.0])
def test_correlation_time_is_found(correlation_s):
    y = draw_noise() + correlated(n, np.random.default_rng(1), 5e-4, correlation_s)
    found = list_candidates(propose.propose_correlated_noise, axis(y))["exponentially_correlated"]
    assert isinstance(found, ExponentiallyCorrelated)
    assert found.correlation_time == pytest.approx(correlation_s, rel=0.35)


def test_correlation_as_long_as_the_recording_is_no_candidate():
    assert (
        list_candidates(
            propose.propose_correlated_noise,
            axis(draw_noise() + walk(n, np.random.default_rng(2), 1e-3)),
            (WHITE,),
        )
        == {}
    )


@pytest.mark.parametrize("exponent", [0.5, 1.5, 2.4])
def test_power_law_is_found(exponent):
    hidden = PowerLaw(density=N, exponent=exponent)
    y = NoiseModel({"gz": (WHITE, hidden)}).simulate(n, RATE_HZ, 3)[:, 2].copy()
    found = list_candidates(propose.propose_power_law, axis(y), (WHITE,))["power_law"]
    assert found.exponent == pytest.approx(exponent, abs=0.2)
    assert list_candidates(propose.propose_power_law, axis(y), (WHITE, found)) == {}


def test_resonance_is_found():
    y = draw_noise() + draw_resonance(n, np.random.default_rng(3), 5e-4, 17.3, 1.0)
    found = list_candidates(propose.propose_resonances, axis(y))["narrowband"]
    assert isinstance(found, Narrowband)
    assert found.frequency == pytest.approx(17.3, abs=0.2)
    assert found.bandwidth == pytest.approx(1.0, rel=0.3)
    one = axis(y)
    middle, width = find_broad_spectral_peaks(whiten(one, MODEL))[0]
    assert middle == pytest.approx(17.3, abs=0.5)
    assert 0.2 < width < 5.0
    assert list_candidates(propose.propose_resonances, axis(draw_noise())) == {}


def test_line_is_found():
    """The accuracy is far better than a bin of the periodogram, which is 1/240 Hz wide."""
    y = draw_noise() + 2e-4 * np.sin(2 * np.pi * 17.3042 * time_s(n))
    one = axis(y)
    found = list_candidates(propose.propose_sinusoids, one)["sinusoidal"]
    assert isinstance(found, Sinusoidal)
    assert found.frequency == pytest.approx(17.3042, abs=5e-4)
    view = whiten(one, MODEL)
    t = time_s(n)
    best = minimize_scalar(
        lambda f: -abs(np.exp(-2j * np.pi * f * t) @ view.series), bounds=(17.303, 17.306), method="bounded"
    )
    assert _line_frequency(view, 17.303) == pytest.approx(best.x, abs=1e-5)
    assert list_candidates(propose.propose_sinusoids, axis(draw_noise(5))) == {}


@pytest.mark.parametrize(
    ("kind", "order"), [("butterworth", 1), ("butterworth", 2), ("butterworth", 4), ("iir", 1), ("iir", 2), ("fir", 1)]
)
@pytest.mark.parametrize("floor", [None, 0.1 * N])
def test_filter_is_found(kind, order, floor):
    hidden = BandwidthLimit(cutoff=14.0, order=order, kind=kind, floor=floor)
    y = NoiseModel({"gz": (WHITE, hidden)}).simulate(n, RATE_HZ, 6)[:, 2].copy()
    found = list_candidates(propose.propose_low_pass, axis(y), (WHITE,))["bandwidth_limit"]
    assert isinstance(found, BandwidthLimit)
    if floor is None:  # a little noise behind one kind can look like another kind
        assert (found.kind, found.order) == (kind, order)
    f_hz, flat = np.linspace(0.5, 49.0, 50), white_noise_spectrum(RATE_HZ * N**2, 1.0 / RATE_HZ)
    fitted = axis(y).fit((WHITE, found)).effects[1]
    response, true = (one.transform_spectrum(flat).density(f_hz) for one in (fitted, hidden))
    assert response == pytest.approx(true, rel=0.2, abs=2e-3 * N**2)
    assert found.cutoff == pytest.approx(14.0, rel=0.05)
    if kind != "iir":  # exponential averages let some noise pass at half the sample rate
        assert (found.floor is None) == (floor is None)
    assert list_candidates(propose.propose_low_pass, axis(y), (WHITE, found)) == {}


def test_effects_of_time_are_found():
    t = time_s(n)
    y = draw_noise() + 1e-3 * np.exp(-t / 9.0) - 5e-4 * (t >= 130.0)
    found = list_candidates(propose.propose_drifts_and_steps, axis(y))
    assert isinstance(found["rate_ramp"], RateRamp)
    transient, step = found["turn_on_transient"], found["bias_step"]
    assert isinstance(transient, TurnOnTransient)
    assert isinstance(step, BiasStep)
    alone = list_candidates(propose.propose_drifts_and_steps, axis(draw_noise() + 1e-3 * np.exp(-t / 9.0)))[
        "turn_on_transient"
    ]
    assert alone.time_constant == pytest.approx(9.0, rel=0.3)
    stepped = list_candidates(propose.propose_drifts_and_steps, axis(draw_noise() - 5e-4 * (t >= 130.0)))["bias_step"]
    assert stepped.time == pytest.approx(130.0, abs=0.5)
    with_ramp = list_candidates(propose.propose_drifts_and_steps, axis(draw_noise()), (*MODEL, RateRamp(R=1e-6)))
    assert "rate_ramp" not in with_ramp


def test_effects_of_temperature_are_found():
    warm = make_temperature(n)
    found = list_candidates(
        propose.propose_temperature_effects, axis(draw_noise() + 3e-4 * (warm - 25.0), temperature_c=warm)
    )
    assert isinstance(found["temperature_bias"], TemperatureBias)
    inside = np.empty(n)  # 20 s behind
    inside[0] = warm[0]
    for k in range(1, n):
        inside[k] = warm[k - 1] + (inside[k - 1] - warm[k - 1]) * np.exp(-1.0 / (20.0 * RATE_HZ))
    late = list_candidates(
        propose.propose_temperature_effects, axis(draw_noise() + 3e-4 * (inside - 25.0), temperature_c=warm)
    )["temperature_lag"]
    assert isinstance(late, TemperatureLag)
    assert late.time_constant == pytest.approx(20.0, rel=0.3)
    loop = TemperatureHysteresis(height=1e-3, reversal=0.8)
    (both,) = build_unit_regressors(loop, n, RATE_HZ, warm)
    found = list_candidates(propose.propose_temperature_effects, axis(draw_noise() + 1e-3 * both, temperature_c=warm))
    assert found["temperature_hysteresis"].reversal == pytest.approx(0.8, rel=0.2)
    assert list_candidates(propose.propose_temperature_effects, axis(draw_noise())) == {}
    assert (
        list_candidates(propose.propose_temperature_effects, axis(draw_noise(), temperature_c=np.full(n, 25.0))) == {}
    )


def test_other_axes_are_proposed_by_their_kind():
    rng = np.random.default_rng(7)
    values = {name: white(n, rng) for name in ("gy", "gz", "ax", "az")}
    every = axes(values, (WHITE,))
    found = {}
    for name, one in every.items():
        offered = propose.propose_leaks_from_other_axes(whiten(one, (WHITE,)))
        found[name] = {(type(effect), effect.source) for effect in offered}
    assert found["gz"] == {(CrossAxis, "gy"), (GSensitivity, "ax"), (GSensitivity, "az")}
    assert found["ax"] == {(CrossAxis, "az")}
    known = (WHITE, CrossAxis(source="gy", coefficient=0.1))
    rest = propose.propose_leaks_from_other_axes(whiten(every["gz"], known))
    assert {effect.source for effect in rest} == {"ax", "az"}


def test_shapes_do_not_depend_on_the_initial_sizes():
    """The sizes of candidates are fitted later, so the unit of the axis does not affect their shapes."""
    y = draw_noise() + correlated(n, np.random.default_rng(8), 5e-4, 0.5)
    one = list_candidates(propose.propose_correlated_noise, axis(y))["exponentially_correlated"]
    scaled = (type(WHITE)(N=1e4 * N), type(WALK)(K=1e4 * WALK.K))
    other = list_candidates(propose.propose_correlated_noise, axis(1e4 * y), scaled)["exponentially_correlated"]
    assert other.correlation_time == pytest.approx(one.correlation_time, rel=1e-2)
