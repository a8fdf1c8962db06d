"""Training: the bytes of the command line's packages."""

from __future__ import annotations

import numpy as np
import pytest

import distributed_observer as do


@pytest.fixture(scope="module")
def paper() -> do.Scenario:
    return do.load("paper")


@pytest.fixture(scope="module")
def recording(paper_result, tmp_path_factory):
    path = tmp_path_factory.mktemp("samples") / "agent1.csv"
    paper_result.samples[1, 1].save(path)
    return path


def test_a_recording_trains_the_package_of_the_command_line(paper, recording, host_sim, tmp_path):
    out = tmp_path / "one.weights"
    report = host_sim("train", recording, "--scenario", "paper", "--agent", "1", "--out", out)
    assert report["stopped_by"] != "interruption"
    package = do.train(recording, paper, 1)
    assert package == out.read_bytes()
    newer = do.train([str(recording)], paper, 1, base=package, seed=3)
    host_sim(
        "train", recording, "--scenario", "paper", "--agent", "1", "--base", out, "--seed", "3",
        "--out", tmp_path / "two.weights",
    )  # fmt: skip
    assert newer == (tmp_path / "two.weights").read_bytes()
    assert do.inspect(newer)["version"] == do.inspect(package)["version"] + 1


def test_samples_of_a_run_train_the_package_of_the_run(paper, paper_result):
    for agent in (1, 2):
        samples = paper_result.samples[agent, 1]
        found = do.inspect(do.train(samples, paper, agent))
        expected = do.inspect(paper_result.packages[agent, 1])
        assert found == expected


def test_arrays_train_as_files_do(paper, paper_result, recording):
    samples = paper_result.samples[1, 1]
    weights = samples.outer_weights
    again = do.Samples(
        samples.time, samples.estimates, samples.derivatives, outer_weights=weights, agent=1
    )
    expected = do.inspect(do.train(samples, paper, 1))
    found = do.inspect(do.train(again, paper, 1))
    # What the agent did meanwhile is not known here.
    assert expected.pop("trial") is not None and found.pop("trial") is None
    for report in (expected, found):
        del report["bytes"], report["overhead_bytes"]
    assert found == expected
    # Rows in any layout and type.
    rows = np.column_stack([samples.time, samples.estimates, samples.derivatives])
    package = do.train(rows, paper, 1)
    assert do.train(np.asfortranarray(rows), paper, 1) == package
    assert do.train(np.repeat(rows, 2, axis=1)[:, ::2], paper, 1) == package


def test_one_network_for_several_agents(paper, paper_result):
    samples = [paper_result.samples[1, 1], paper_result.samples[2, 1]]
    packages = do.train(samples, paper, [1, 2])
    assert [do.inspect(package)["agent"] for package in packages] == [1, 2]
    with pytest.raises(do.ObserverError, match=r"samples\[1\]: samples of agent 2, not of agent 1") as raised:
        do.train(samples, paper, [1])
    assert raised.value.code == "invalid-samples"


def test_wrong_samples_are_refused(paper):
    rows = np.zeros((30, 7))
    rows[:, 0] = np.arange(30) / 1000
    cases = [
        (rows[:, :6], "samples has 6 columns; give 7: the time, 3 of the estimate and 3 of its derivative"),
        (rows[0], r"samples has the shape \(7,\); give an array with two axes"),
        (rows[:1], "samples: 1 samples, expected at least 2"),
        (rows[::-1], "samples:2: time not increasing"),
        (np.where(rows == rows[3, 0], np.nan, rows), 'samples:4: "time" is NaN; use a finite number'),
    ]
    for samples, text in cases:
        with pytest.raises(do.ObserverError, match=text):
            do.train(samples, paper, 1)
    with pytest.raises(TypeError, match="samples holds"):
        do.train([["x"] * 7], paper, 1)
    with pytest.raises(do.ObserverError, match="give one time for each row"):
        do.Samples(rows[:-1, 0], rows[:, 1:4], rows[:, 4:])
    with pytest.raises(do.ObserverError, match="outer_weights have the shape"):
        do.Samples(rows[:, 0], rows[:, 1:4], rows[:, 4:], outer_weights=np.zeros((5, 2)))
    flat = do.Samples(rows[:, 0], rows[:, 1:3], rows[:, 4:6])
    assert len(flat) == 30 and repr(flat).startswith("<Samples: 30 rows, one every 0.001")
    with pytest.raises(do.ObserverError, match="estimates have 2 components, but the scenario's state has 3"):
        do.train(flat, paper, 1)
    with pytest.raises(do.ObserverError, match="agent=1: given twice"):
        do.train(rows, paper, [1, 1])
    with pytest.raises(do.ObserverError, match="give the number of at least one"):
        do.train(rows, paper, [])


def test_warnings_about_samples_are_given(paper, recording):
    text = recording.read_text().splitlines(keepends=True)
    head = "# agent: 1\n# scenario: other, hash 0x0123456789abcdef\n"
    (other := recording.with_name("other.csv")).write_text(head + "".join(text))
    with pytest.warns(do.ObserverWarning, match="recorded with scenario other") as given:
        do.train(other, paper, 1)
    assert given[0].message.code == "other-scenario"


def test_a_network_that_explains_nothing_is_not_packed(paper):
    generator = np.random.default_rng(1)
    rows = generator.normal(size=(600, 7))
    rows[:, 0] = np.arange(600) / 1000
    with pytest.warns(do.ObserverWarning), pytest.raises(do.ObserverError) as raised:
        do.train(rows, paper, 1)
    assert raised.value.code == "not-packed"


def test_rows_of_numbers_are_one_table(paper, paper_result):
    samples = paper_result.samples[1, 1]
    table = np.column_stack((samples.time, samples.estimates, samples.derivatives))
    expected = do.train(table, paper, 1, progress=False)
    assert do.train(table.tolist(), paper, 1, progress=False) == expected
    assert do.train((table,), paper, 1, progress=False) == expected
    with pytest.raises(TypeError, match="one or the other"):
        do.train(["recording.csv", samples], paper, 1)
