"""Groups and parts of the numerical kernels. Each part has a function that calls all its kernels.

The functions import the modules of the kernels when they are called. A command whose kernels are compiled does not call
the functions and therefore does not import these modules.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.data_types import SampleBlock, make_block
from drivers.host.extras import find_missing_packages


@dataclass(frozen=True, slots=True)
class KernelPart:
    """Kernels that are compiled together."""

    name: str  # name of the computation, as shown to the user
    prepare: Callable[[], None]  # calls each kernel with all argument types of the program


@dataclass(frozen=True, slots=True)
class KernelGroup:
    """Parts of the kernels that are needed together, in order of dependency."""

    name: str
    parts: tuple[KernelPart, ...]


def _samples(n: int) -> SampleBlock:
    return make_block(np.arange(n, dtype=np.int64), np.zeros((n, 6)))


def _call_window() -> None:
    from monitor.estimation.allan.window import AllanWindow
    from monitor.estimation.estimator import Estimator

    Estimator(100.0, 1.0).add_samples(_samples(100))
    AllanWindow(100, np.array([1])).avar()  # the first estimates are published before the kernels of the fit are ready


def _call_fit() -> None:
    from monitor.estimation.estimator import Estimator

    estimator = Estimator(100.0, 1.0)
    estimator.add_samples(_samples(100))
    estimator.get_estimate()


def _call_motion_detection() -> None:
    from monitor.estimation.detection.motion_and_change_monitor import MotionAndChangeMonitor

    MotionAndChangeMonitor(100.0, alarms_per_day=0.0).process_samples(_samples(100))


def _call_change_detection() -> None:
    from monitor.estimation.detection.change_kernel import make_change_state, set_next_decision_sample
    from monitor.estimation.detection.motion_and_change_monitor import MotionAndChangeMonitor

    MotionAndChangeMonitor(100.0).process_samples(_samples(100))
    set_next_decision_sample(make_change_state(1))


def _call_compensation() -> None:
    from monitor.drift.compensation.arma import fit_arma
    from monitor.drift.compensation.gyro_drift_compensator import Compensator

    compensator = Compensator(100.0)
    compensator.compensate(1e-3 * np.random.default_rng(0).standard_normal((6000, 6)))
    compensator.apply_identification_result(
        0, fit_arma(*compensator.means_and_noise_variance_for_identification(0), [(2, 1)])
    )
    compensator.compensate(np.zeros((1, 6)), lost=1)


def _call_slow_statistics() -> None:
    from monitor.estimation.estimator import Estimator

    estimator = Estimator(100.0, 1.0)
    estimator.add_samples(_samples(100))
    estimator.restart_axis(0, 10)
    while estimator.step_slow_statistics() is None:
        pass


def _call_refit() -> None:
    from monitor.estimation.estimator import Estimator

    Estimator(100.0, 1.0, every_sample=True).add_samples(_samples(100))


def _call_thermal_model() -> None:
    from monitor.common.distributions import student_quantile
    from monitor.drift.thermal import interval_regression, thermal_response

    student_quantile(1, 0.975)
    thermal_response.apply_first_order_lag(np.zeros(2), 0.5)
    interval_regression.whiten_columns(np.zeros((2, 1)), np.ones(2, np.bool_), interval_regression.NOISE_MODELS)


def _call_analysis() -> None:
    from monitor.estimation.analysis import analyze

    analyze([_samples(100)], 100.0)


def _call_reconciliation() -> None:
    from monitor.noise.effects import AngleRandomWalk, BiasInstability, RateRandomWalk
    from monitor.noise.model import NoiseModel
    from monitor.reconcile.preparation.reconcile_input import RecordedAxes
    from monitor.reconcile.reconcile import reconcile

    model = NoiseModel({"gz": (AngleRandomWalk(N=1e-4), BiasInstability(B=3e-5), RateRandomWalk(K=1e-6))})
    series, rng = model.simulate(4200, 10.0, 1)[:, 2], np.random.default_rng(1)
    size = float(np.std(series))
    series += 4.0 * size * (rng.integers(0, 2, 42).repeat(100) + (np.arange(4200) > 2100))
    series[::500] += 20.0 * size
    reconcile(RecordedAxes({"gz": series}, 10.0, np.linspace(20.0, 30.0, 4200)), model, seed=1)


WINDOW: Final = "Allan deviation"
"""Name of the kernel part for the sliding window."""
FIT: Final = "noise coefficients"
"""Name of the kernel part for the fit."""
SERVICE: Final = KernelGroup(
    "service",
    (
        KernelPart(WINDOW, _call_window),
        KernelPart("motion detection", _call_motion_detection),
        KernelPart(FIT, _call_fit),
        KernelPart("change detection", _call_change_detection),
        KernelPart("drift compensation", _call_compensation),
        KernelPart("total and Hadamard deviation", _call_slow_statistics),
        KernelPart("refit at every sample", _call_refit),
        KernelPart("thermal model", _call_thermal_model),
    ),
)
"""Parts that the service needs, in order of use."""
_ANALYSIS: Final = KernelPart("analysis of recordings", _call_analysis)
_RECONCILIATION: Final = KernelPart("reconciliation", _call_reconciliation)
COMMANDS: Final = KernelGroup(
    "commands", (_ANALYSIS,) if find_missing_packages("reconcile") else (_ANALYSIS, _RECONCILIATION)
)
"""Parts that only the commands for recordings need."""
GROUPS: Final = (SERVICE, COMMANDS)
"""All groups of kernels."""
