"""Test of a small fleet of daemons and routers: every daemon is seen, and a killed daemon is reported."""

from tests.experiments.benchmarks.fleet import run_fleet


def test_four_daemons_behind_three_routers_are_seen_and_a_killed_one_is_reported() -> None:
    found = run_fleet(4, 10.0, "1 Hz", 3.0)
    assert found["seen"] == {"running": 4}
    assert found["payload bytes/s of a device"]["status"] > 100
    assert found["dropped"] == 0
    # the token of the killed daemon disappeared, and the table showed it; the benchmark measures the delay
    assert found["killed"].keys() == {"token gone after s", "shown after s"}
