"""Kernels are compiled before the first test: processes that tests start find them on disk, as on any later start."""

import pytest

from monitor.drift import compensator, heat
from monitor.estimate.estimator import warm_up


@pytest.fixture(scope="session", autouse=True)
def _kernels() -> None:
    assert list(warm_up()) == ["window", "fit", "all"]
    heat.warm_up()
    compensator.warm_up()
