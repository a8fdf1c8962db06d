"""An agent stepped by hand: the bits of the simulated agents."""

from __future__ import annotations

import numpy as np
import pytest

import distributed_observer as do
from conftest import SHORT


def drive(scenario: do.Scenario, packages: list[bytes], traces: dict, steps: int) -> np.ndarray:
    """Step all agents by hand over the plant's trajectory; returns their estimates, shape [k, N, n]."""
    numbers = range(1, scenario.agents + 1)
    agents = [
        do.Agent(package, estimate=scenario.initial_estimate(number), health=False)
        for number, package in zip(numbers, packages, strict=True)
    ]
    outputs = [scenario.output_matrix(number) for number in numbers]
    hears = [scenario.neighbours(number) for number in numbers]
    state = traces["state"]
    frames = [agent.announcement() for agent in agents]
    estimates = [[agent.estimate for agent in agents]]
    for step in range(steps):
        for agent, heard in zip(agents, hears, strict=True):
            for sender in heard:
                if frames[sender - 1] is not None:
                    agent.receive(frames[sender - 1])
        frames = [agent.step(c @ state[step]) for agent, c in zip(agents, outputs, strict=True)]
        estimates.append([agent.estimate for agent in agents])
    return np.array(estimates)


def test_agents_by_hand_have_the_bits_of_the_papers_run():
    scenario = do.load("paper", set={"learning": []})
    result = scenario.run()
    packages = [scenario.package(number) for number in (1, 2, 3)]
    found = drive(scenario, packages, result.traces, scenario.steps)
    assert found.tobytes() == result.traces["estimates"].tobytes()


def test_agents_by_hand_have_the_bits_with_trained_packages(paper_result, short):
    packages = [paper_result.packages[number, 1] for number in (1, 2, 3)]
    result = short.run(packages=packages)
    found = drive(short, packages, result.traces, short.steps)
    assert found.tobytes() == result.traces["estimates"].tobytes()


def test_the_field_observer_steps_by_hand():
    scenario = do.load("paper", set={**SHORT, "observer.preset": "field", "observer.from": 0.0})
    result = scenario.run()
    packages = [scenario.package(number) for number in (1, 2, 3)]
    found = drive(scenario, packages, result.traces, scenario.steps)
    assert found.tobytes() == result.traces["estimates"].tobytes()
    frame = do.Agent(packages[0]).step([1.0])
    assert do.decode(frame)["kind"] == "field" and do.decode(frame)["estimate"] is None
    content = do.decode(frame, dimension=3)
    assert content["estimate"].shape == (3,)
    assert content["announced"]["hold"] == "rate" and content["announced"]["rate"].shape == (3,)


@pytest.mark.parametrize("name", ["lorenz", "duffing", "pendulum", "expressions"])
def test_agents_of_any_dimension_are_made(name):
    scenario = do.load(name)
    package = scenario.package(1)
    if package is None:
        pytest.skip("no network")
    agent = do.Agent(package)
    assert agent.estimate.shape == (scenario.dimension,)
    agent.step(np.zeros(scenario.output_matrix(1).shape[0]))
    assert agent.tick == 1


@pytest.fixture
def agent() -> do.Agent:
    return do.Agent(do.load("paper").package(1))


def test_measurements_of_every_kind_give_the_same_bits(agent):
    expected = None
    package = agent.package
    for measurement in (
        np.array([0.75], dtype=np.float32),
        np.array([0.75]),
        np.array([0.0, 0.75, 0.0])[1::3],
        np.array([0.75, 9.0], dtype=np.float32)[::-1][1:],
        np.array([0.75], dtype=np.float16),
        np.array([0.75], dtype=">f8"),
        np.array(0.75),
        np.float64(0.75),
        0.75,
        [0.75],
        (0.75,),
    ):
        fresh = do.Agent(package)
        fresh.step(measurement)
        bits = fresh.estimate.tobytes()
        expected = expected or bits
        assert bits == expected, measurement
    whole = do.Agent(package)
    whole.step(3)
    same = do.Agent(package)
    same.step(np.array([3]))
    assert whole.estimate.tobytes() == same.estimate.tobytes()


def test_read_only_arrays_are_read(agent):
    measurement = np.array([0.5], dtype=np.float32)
    measurement.flags.writeable = False
    agent.step(measurement)


def test_wrong_measurements_are_refused_and_change_nothing(agent):
    before = agent.estimate
    for measurement, text in [
        ([1.0, 2.0], "2"),
        ([], "0"),
        (np.zeros((1, 1)), r"measurement has the shape \(1, 1\); give an array with one axis"),
        ([float("nan")], "finite"),
        ([float("inf")], "finite"),
        ([1e300], "finite"),
    ]:
        with pytest.raises(do.ObserverError, match=text):
            agent.step(measurement)
        assert agent.tick == 0
        assert agent.estimate.tobytes() == before.tobytes()
    with pytest.raises(TypeError, match="measurement holds complex128; give real numbers"):
        agent.step([1j])
    with pytest.raises(TypeError, match="measurement holds <U1; give real numbers"):
        agent.step(["x"])
    assert agent.health["measurements_not_finite"] == 3


def test_without_a_measurement_it_goes_on(agent):
    agent.step()
    agent.step(None)
    assert agent.tick == 2
    agent.step([1.0], tick=10)
    assert agent.tick == 11 and agent.health["skipped_ticks"] > 0
    with pytest.raises(do.ObserverError) as raised:
        agent.step([1.0], tick=5)
    assert raised.value.code == "run-failed"


def test_an_agent_shows_its_state(agent):
    assert (agent.number, agent.tick, agent.network_in_use) == (1, 0, True)
    assert agent.derivative is None
    agent.step([1.0])
    assert agent.derivative.shape == (3,)
    assert agent.outer_weights.shape == (5, 3)
    assert repr(agent) == "<Agent 1 at tick 1>"
    estimate = agent.estimate
    estimate[:] = 0.0
    assert agent.estimate.any(), "a copy"


def test_wrong_estimates_are_refused():
    package = do.load("paper").package(1)
    with pytest.raises(do.ObserverError, match="has 2 components; give the 3") as raised:
        do.Agent(package, estimate=[1.0, 2.0])
    assert raised.value.code == "usage"
    with pytest.raises(do.ObserverError, match="not finite"):
        do.Agent(package, estimate=[1.0, 2.0, float("nan")])


def test_frames_are_decoded_and_damaged_ones_refused(agent):
    frame = do.Agent(do.load("paper").package(2), estimate=[1.0, -2.0, 0.5]).announcement()
    content = do.decode(frame)
    assert (content["sender"], content["sequence"], content["tick"]) == (2, 0, 0)
    np.testing.assert_array_equal(content["estimate"], np.array([1.0, -2.0, 0.5], dtype=np.float32))
    assert content["announced"] is None
    agent.receive(frame)
    damaged = bytes([frame[0], frame[1] ^ 1, *frame[2:]])
    for call in (lambda: do.decode(damaged), lambda: agent.receive(damaged)):
        with pytest.raises(do.ObserverError, match="checksum does not match") as raised:
            call()
        assert raised.value.code == "invalid-frame"
    with pytest.raises(do.ObserverError, match="agent 1 is not a neighbour"):
        agent.receive(agent.announcement())
    with pytest.raises(do.ObserverError, match="3 components, expected 2"):
        do.decode(frame, dimension=2)
    with pytest.raises(do.ObserverError, match="frame length: 0 bytes"):
        do.decode(b"")


def test_damaged_packages_are_refused():
    package = bytearray(do.load("paper").package(1))
    do.Agent(package)
    package[200] ^= 1
    with pytest.raises(do.ObserverError, match="^package: .*checksum.*; copy it again, or train again") as raised:
        do.Agent(package)
    assert raised.value.code == "invalid-package"
    with pytest.raises(TypeError):
        do.Agent(5)


def packed(values: np.ndarray) -> np.ndarray:
    """The same numbers as a field of a packed structured array, which is not aligned."""
    table = np.zeros(len(values), dtype=[("k", "i1"), ("t", values.dtype), ("rest", "i2")])
    table["t"] = values
    return table["t"]


@pytest.mark.parametrize("dtype", ["<f4", "<f8", ">f4", ">f8", "i2"])
@pytest.mark.parametrize("form", [packed, lambda values: values[::-1][::-1], np.ndarray.tolist])
def test_numbers_are_the_same_in_every_layout(paper_result, dtype, form):
    package = paper_result.packages[1, 1]
    values = np.array([3, -2], dtype=dtype)
    plain, other = do.Agent(package, estimate=[3, -2, 1]), None
    other = do.Agent(package, estimate=form(np.array([3, -2, 1], dtype=dtype)))
    assert plain.estimate.tobytes() == other.estimate.tobytes()
    plain.step(values[:1].astype("f4"))
    other.step(form(values[:1]))
    assert plain.estimate.tobytes() == other.estimate.tobytes()


def test_frames_may_be_in_any_buffer(paper_result):
    sender, package = do.Agent(paper_result.packages[1, 1]), paper_result.packages[2, 1]
    frame = sender.announcement()
    expected = do.Agent(package)
    expected.receive(frame)
    expected.step([0.5])
    for buffer in (bytearray(frame), memoryview(frame), memoryview(bytearray(frame))):
        agent = do.Agent(package)
        agent.receive(buffer)
        agent.step([0.5])
        assert agent.estimate.tobytes() == expected.estimate.tobytes()
        assert do.decode(buffer)["sender"] == 1
    with pytest.raises(TypeError, match="frame is of type str; give bytes"):
        agent.receive("frame")
