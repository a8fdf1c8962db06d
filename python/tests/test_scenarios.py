"""Scenarios: loading, building, changing."""

from __future__ import annotations

import numpy as np
import pytest

import distributed_observer as do
from conftest import SHORT


def test_built_in_scenarios_load_by_name():
    assert "paper" in do.scenarios() and "deployment" in do.scenarios()
    for name in do.scenarios():
        assert do.load(name).name == name


def test_a_scenario_describes_itself():
    paper = do.load("paper")
    assert repr(paper) == "<Scenario paper: 3 agents, 3 states, 40 s>"
    assert (paper.agents, paper.dimension, paper.steps) == (3, 3, 40000)
    assert (paper.step_size, paper.duration, paper.state_names) == (1e-3, 40.0, ["x", "y", "z"])
    np.testing.assert_array_equal(paper.output_matrix(2), [[0.0, 1.0, 0.0]])
    assert paper.neighbours(1) == [2, 3] and paper.neighbours(3) == [1]
    assert paper.initial_estimate(1).shape == (3,)
    with pytest.raises(do.ObserverError, match="scenario paper has agents 1 to 3"):
        paper.neighbours(4)


def test_text_and_files_are_read_alike(tmp_path):
    text = do.load("paper").text
    path = tmp_path / "mine.toml"
    path.write_text(text)
    digests = {
        do.load(path, set=SHORT).run().digest,
        do.load(str(path), set=SHORT).run().digest,
        do.Scenario.from_toml(text, set=SHORT).run().digest,
        do.Scenario.from_toml(text).with_changes(SHORT).run().digest,
    }
    assert len(digests) == 1


def test_keys_change_with_values_of_python(tmp_path):
    changed = do.load(
        "paper",
        set={
            "design.epsilon": np.float32(500),
            "link.loss": 0.1,
            "plant.initial_state": np.array([1.0, 2.0, 3.0]),
            "agents.2.sensor.noise": 0.01,
            "record.events": False,
            "record.trace_stride": np.int64(10),
            "observer.preset": "field",
            "outer_law.gain.scale": 2,
        },
    )
    for line in ["epsilon = 500.0", "initial_state = [1.0, 2.0, 3.0]", "events = false"]:
        assert line in changed.text
    assert 'preset = "field"' in changed.text
    assert "scale = 2" in changed.text
    with pytest.raises(do.ObserverError, match='`a "name"` cannot be used in file names'):
        do.load("paper", set={"name": 'a "name"'})


def test_wrong_changes_are_refused():
    with pytest.raises(TypeError, match="set: learning: object is not a TOML value; give a number"):
        do.load("paper", set={"learning": object()})
    with pytest.raises(do.ObserverError, match="a dotted path|key") as raised:
        do.load("paper", set={"a b": 1})
    assert raised.value.code == "usage"
