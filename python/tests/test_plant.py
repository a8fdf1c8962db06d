"""A Python callable as the plant."""

from __future__ import annotations

import threading

import numpy as np
import pytest

import distributed_observer as do
from conftest import SHORT

MATRIX = np.array([[0.0, 1.0, 0.0], [-4.0, -0.5, 0.0], [0.0, 0.25, -1.0]])

LINEAR = {
    **SHORT,
    "plant": {"model": "linear", "parameters": {"matrix": MATRIX.tolist()}, "initial_state": [1.0, 2.0, 3.0]},
}


def linear(x, t):
    """The same sums in the same order as the library."""
    return [((0.0 + row[0] * x[0]) + row[1] * x[1]) + row[2] * x[2] for row in MATRIX]


@pytest.fixture(params=["euler", "rk4"])
def scenario(request) -> do.Scenario:
    return do.load("paper", set={**LINEAR, "time.plant_integrator": request.param})


def test_a_callable_gives_the_bits_of_the_same_equations(scenario):
    expected = scenario.run()
    found = scenario.with_plant(linear).run()
    assert found.digest == expected.digest
    assert found.traces["state"].tobytes() == expected.traces["state"].tobytes()


@pytest.mark.parametrize("form", [np.array, list, tuple, lambda dx: np.array([dx, dx]).T[:, 0]])
def test_derivatives_of_every_kind_are_taken(scenario, form):
    expected = scenario.run().digest
    assert scenario.with_plant(lambda x, t: form(linear(x, t))).run().digest == expected


def test_the_callable_gets_state_and_time():
    seen = []

    def plant(x, t):
        seen.append((x.copy(), t))
        return np.zeros(3)

    scenario = do.load("paper", set={**LINEAR, "time.plant_integrator": "euler", "disturbance": {"model": "none"}})
    scenario.with_plant(plant).run()
    assert len(seen) >= 1000
    times = sorted({t for _, t in seen})
    np.testing.assert_allclose(times, np.arange(1001) / 1000)
    assert all(x.tolist() == [1.0, 2.0, 3.0] for x, _ in seen)


def test_an_exception_of_the_callable_ends_the_run(scenario):
    class Broken(Exception):
        pass

    def plant(x, t):
        if t > 0.5:
            raise Broken("at half time")
        return linear(x, t)

    broken = scenario.with_plant(plant)
    with pytest.raises(Broken, match="at half time"):
        broken.run()
    # It can be run again.
    with pytest.raises(Broken):
        broken.run(threads=1)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ([1.0, 2.0], "the plant returned 2 numbers at t = 0; return the derivative of all 3 state components"),
        ([1.0, float("nan"), 2.0], "the plant returned NaN as the derivative of component 2 at t = 0, x = "),
        ([[1.0, 2.0, 3.0]], r"the derivative of the plant has the shape \(1, 3\)"),
    ],
)
def test_wrong_derivatives_say_what_is_wrong(scenario, value, text):
    with pytest.raises(do.ObserverError, match=text) as raised:
        scenario.with_plant(lambda x, t: value).run()
    assert raised.value.code == "usage"


def test_a_diverging_plant_is_reported_as_on_the_command_line(scenario):
    with pytest.raises(do.ObserverError) as raised:
        scenario.with_plant(lambda x, t: np.full(3, 1e45)).run()
    assert raised.value.code == "plant-diverged"


def test_what_is_not_a_plant_is_refused(scenario):
    with pytest.raises(TypeError, match="the plant is not callable"):
        scenario.with_plant(5)
    with pytest.raises(do.ObserverError, match="2 state names; give one for each of the 3"):
        scenario.with_plant(linear, state_names=["a", "b"])
    named = scenario.with_plant(linear, state_names=["a", "b", "c"])
    assert named.state_names == ["a", "b", "c"] and "plant in Python" in repr(named)
    assert named.with_changes({"design.epsilon": 500.0}).state_names == ["a", "b", "c"]
    assert named.run().state_names == ["a", "b", "c"]


def test_callables_learn_and_run_from_several_threads():
    scenario = do.load("paper", set={**LINEAR, "time.plant_integrator": "euler"}).with_plant(linear)
    digests = []

    def run():
        digests.append(scenario.run(baselines=["no-network", "untrained"]).digest)

    threads = [threading.Thread(target=run) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(digests) == 3 and len(set(digests)) == 1


def test_changes_are_checked_against_the_plant():
    changed = do.load("duffing").with_plant(lambda x, t: [x[1], -x[0]], state_names=["a", "b"])
    assert changed.with_changes({"record.trace_stride": 2}).state_names == ["a", "b"]
    with pytest.raises(do.ObserverError):
        changed.with_changes({"plant.model": "lorenz", "plant.initial_state": [1.0, 1.0, 1.0]})
    default = do.load("duffing").with_plant(lambda x, t: [x[1], -x[0]])
    assert default.state_names == ["x", "v"]
