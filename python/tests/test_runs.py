"""Runs: the same bits and the same report as on the command line."""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import distributed_observer as do
from conftest import CHECKOUT, SHORT


def golden(name: str) -> int:
    """Return a digest that the tests of the library hold the paper's run against."""
    text = (CHECKOUT / "tests/sim/determinism.rs").read_text()
    found = re.search(rf"const {name}: u64 = (0x[0-9a-f_]+);", text)
    assert found
    return int(found[1].replace("_", ""), 16)


def test_the_papers_run_has_the_golden_digests(paper_result):
    assert paper_result.digest == golden("DIGEST_WITH_LEARNING")
    without = do.load("paper").run(learning=False)
    assert without.digest == golden("DIGEST_WITHOUT_LEARNING")
    assert without.packages == {} and without.trainings == []


def test_the_report_is_that_of_the_command_line(paper_result, host_sim, tmp_path):
    expected = host_sim("run", "paper", cwd=tmp_path)
    found = dict(paper_result.report)
    for report in (expected, found):
        del report["elapsed_s"]
    assert found == expected
    # And what it writes into files.
    folder = tmp_path / "out/paper"
    for (agent, cycle), package in paper_result.packages.items():
        assert (folder / f"agent{agent}_cycle{cycle}.weights").read_bytes() == package
    with (folder / "traces.csv").open() as file:
        header = file.readline().strip().split(",")
        last = file.readlines()[-1].strip().split(",")
    frame = paper_result.traces_frame()
    names = [re.sub(r" \[.*\]", "", name) for name in header]
    assert names == ["time", *frame.columns]
    assert [np.float32(number) for number in last[1:]] == [np.float32(x) for x in frame.iloc[-1]]


def test_results_have_arrays_with_documented_shapes(paper_result):
    traces = paper_result.traces
    assert {name: array.shape for name, array in traces.items()} == {
        "time": (40001,),
        "state": (40001, 3),
        "estimates": (40001, 3, 3),
        "errors": (40001, 3),
    }
    assert traces["estimates"].dtype == np.float32
    errors = np.linalg.norm(traces["estimates"] - traces["state"][:, None, :], axis=2)
    np.testing.assert_allclose(traces["errors"], errors, rtol=1e-12)
    for agent, events in zip(paper_result.agents, paper_result.events, strict=True):
        assert len(events) == agent["broadcasts"]
    assert [agent["agent"] for agent in paper_result.agents] == [1, 2, 3]
    assert paper_result.checks["theorem1"]["status"] == "not_applicable"
    assert {"code", "text"} == set(paper_result.warnings[0])


def test_data_frames_and_the_table_of_notebooks(paper_result):
    frame = paper_result.agents_frame()
    assert list(frame.index) == [1, 2, 3]
    assert frame.loc[2, "rmse"] == paper_result.agents[1]["rmse"]
    assert len(paper_result.trainings_frame()) == 3
    assert "rmse_no_network" in paper_result._repr_html_()
    assert repr(paper_result) == "<Result of paper, seed 0: 3 agents>"


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_threads_change_no_bit(short, threads):
    assert short.run(threads=threads).digest == short.run().digest


def test_seeds_count_where_something_is_random():
    noisy = do.load("paper", set={**SHORT, "sensor.noise": 0.01})
    assert noisy.run(seed=1).digest == noisy.run(1).digest
    assert noisy.run(seed=1).digest != noisy.run(seed=2).digest


def test_runs_beside_each_other_do_not_disturb_each_other(short):
    other = short.with_changes({"design.epsilon": 500.0})
    expected = [short.run().digest, other.run().digest]
    with ThreadPoolExecutor(4) as pool:
        runs = [pool.submit(scenario.run) for scenario in (short, other) * 4]
        assert [run.result().digest for run in runs] == expected * 4


def test_packages_replace_the_scenarios_network(paper_result, short):
    plain = short.run()
    given = short.run(packages=[paper_result.packages[1, 1]])
    assert given.digest != plain.digest
    assert given.report["baselines"]["no_network"]["status"] == "done"
    with pytest.raises(do.ObserverError, match="second package for agent 1; give at most one") as raised:
        short.run(packages=[paper_result.packages[1, 1]] * 2)
    assert raised.value.code == "usage"


def test_baselines_are_chosen_by_name(short):
    assert short.run().agents[0]["rmse_no_network"] is None
    result = short.run(baselines=["no-network"])
    assert result.agents[0]["rmse_no_network"] > 0
    with pytest.raises(do.ObserverError, match="unknown method 'ours'|unknown method \"ours\""):
        short.run(baselines=["ours"])
    with pytest.raises(do.ObserverError, match="`all` cannot be combined") as raised:
        short.run(baselines=["all", "kalman"])
    assert raised.value.code == "usage"


def test_an_unstable_run_raises_with_its_result():
    unstable = do.load("paper", set={**SHORT, "time.step": 0.025, "design.gain.scale": 0.9})
    with pytest.raises(do.ObserverError) as raised:
        unstable.run()
    error = raised.value
    assert error.code in {"unstable", "run-failed"}
    if error.code == "unstable":
        assert isinstance(error.result, do.Result)


def test_wrong_arguments_are_refused(short):
    with pytest.raises(do.ObserverError, match="threads is 1025; give 0 to 1024"):
        short.run(threads=1025)
    with pytest.raises(OverflowError):
        short.run(seed=-1)
    with pytest.raises(TypeError):
        short.run(seed=0.5)


def test_samples_tell_states_from_known_inputs():
    tanks = CHECKOUT / "host-sim/examples/experiment/tanks.toml"
    short = {"time.duration": 30.0, "learning.1.collect_to": 20.0, "learning.1.apply_at": 25.0}
    window = {"evaluation.from": 26.0, "evaluation.to": 30.0, "record.samples": True}
    scenario = do.load(tanks, set=short | window)
    samples = scenario.run(baselines=[]).samples[1, 1]
    rows = len(samples)
    assert samples.estimates.shape == samples.derivatives.shape == (rows, 3)
    assert samples.known_inputs.shape == (rows, 1)
    # The pump: 0.55 + 0.22 sin(0.35 t) +- 0.12 dm/s.
    assert 0.2 < samples.known_inputs.min() < samples.known_inputs.max() < 0.9
    with pytest.raises(do.ObserverError, match="known inputs"):
        do.train(samples, scenario, agent=1)
