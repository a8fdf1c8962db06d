"""Errors: the code and the text of the command line."""

from __future__ import annotations

import pickle

import pytest

import distributed_observer as do

WRONG = [
    (["run", "nothing.toml"], lambda: do.load("nothing.toml")),
    (["run", "wrong.toml"], lambda: do.load("wrong.toml")),
    (
        ["run", "paper", "--set", "link.los=0.1"],
        lambda: do.load("paper", set={"link.los": 0.1}),
    ),
    (
        ["run", "paper", "--set", "design.epsilon=-1"],
        lambda: do.load("paper", set={"design.epsilon": -1}),
    ),
    (["weights", "inspect", "wrong.toml"], lambda: do.inspect("wrong.toml")),
    (["weights", "verify", "nothing.weights"], lambda: do.verify("nothing.weights")),
    (
        ["weights", "sign", "good.weights", "--key", "wrong.toml"],
        lambda: do.sign("good.weights", "wrong.toml"),
    ),
    (
        ["train", "wrong.toml", "--scenario", "paper", "--agent", "1", "--out", "new.weights"],
        lambda: do.train("wrong.toml", do.load("paper"), 1),
    ),
    (
        ["train", "good.csv", "--scenario", "paper", "--agent", "4", "--out", "new.weights"],
        lambda: do.train("good.csv", do.load("paper"), 4),
    ),
    (
        ["train", "good.csv", "--scenario", "paper", "--agent", "1", "--recipe", "none", "--out", "new"],
        lambda: do.train("good.csv", do.load("paper"), 1, recipe="none"),
    ),
    (
        ["train", "good.csv", "--scenario", "paper", "--agent", "1", "--out", "new.weights"],
        lambda: do.train("good.csv", do.load("paper"), 1),
    ),
    (
        ["run", "paper", "--set", "plant={ model = \"expressions\", states = [\"x\"], derivative = [\"1/x\"] }"],
        lambda: do.load("paper", set={"plant": {"model": "expressions", "states": ["x"], "derivative": ["1/x"]}}),
    ),
]


@pytest.mark.parametrize(("arguments", "call"), WRONG, ids=[" ".join(line)[:60] for line, _ in WRONG])
def test_errors_are_those_of_the_command_line(arguments, call, host_sim, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "wrong.toml").write_text("name = 'x'\ntimes = {}\n")
    (tmp_path / "good.weights").write_bytes(do.load("paper").package(1))
    (tmp_path / "good.csv").write_text(
        "time,xhat1,xhat2,xhat3,dxhat1,dxhat2,dxhat3\n"
        + "".join(f"{step / 1000},1,2,3,4,5,6\n" for step in range(30))
    )
    expected = host_sim(*arguments, cwd=tmp_path)["error"]
    with pytest.raises(do.ObserverError) as raised:
        call()
    error = raised.value
    assert (str(error), error.code) == (expected["text"], expected["code"])
    assert (error.file, error.line) == (expected["file"], expected["line"])


def test_a_failing_run_raises_the_error_of_the_command_line(host_sim, tmp_path):
    changes = {
        "plant": {
            "model": "expressions",
            "states": ["x", "y", "z"],
            "derivative": ["x^3", "-y", "-z"],
            "initial_state": [5.0, 1.0, 1.0],
        }
    }
    line = '{ model = "expressions", states = ["x", "y", "z"], derivative = ["x^3", "-y", "-z"], initial_state = [5.0, 1.0, 1.0] }'
    expected = host_sim("run", "paper", "--set", f"plant={line}", cwd=tmp_path)["error"]
    with pytest.raises(do.ObserverError) as raised:
        do.load("paper", set=changes).run()
    assert (str(raised.value), raised.value.code) == (expected["text"], expected["code"])


def test_errors_can_be_pickled_and_made_in_python():
    error = do.ObserverError("wrong", "usage", "mine.toml", 3)
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.code, again.file, again.line) == ("wrong", "usage", "mine.toml", 3)
    assert do.ObserverError("wrong").code == "usage"
