"""What several tests need."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

import distributed_observer as do

CHECKOUT = Path(__file__).parents[2]

#: A short run of the paper's experiment, without learning.
SHORT = {
    "learning": [],
    "time.duration": 1.0,
    "evaluation": {"from": 0.5, "to": 1.0},
}


@pytest.fixture(scope="session")
def paper_result() -> do.Result:
    """The paper's run."""
    return do.load("paper").run()


@pytest.fixture
def short() -> do.Scenario:
    return do.load("paper", set=SHORT)


def command_line() -> str | None:
    """Return the path of the command line."""
    if "HOST_SIM" in os.environ:
        return os.environ["HOST_SIM"]
    target = Path(os.environ.get("CARGO_TARGET_DIR", CHECKOUT / "target"))
    names = ["release/host-sim", "debug/host-sim", "debug/simulator-under-test"]
    return next((str(target / name) for name in names if (target / name).is_file()), None)


@pytest.fixture(scope="session")
def host_sim() -> Callable[..., dict[str, Any]]:
    """Call the command line and return what it prints as JSON, errors included."""
    program = command_line()
    if program is None:
        pytest.skip("the command line is not built; cargo build --release")

    def call(*arguments: str | Path, cwd: Path | None = None) -> dict[str, Any]:
        line: Sequence[str | Path] = [program, *arguments, "--format=json"]
        done = subprocess.run(line, capture_output=True, cwd=cwd, text=True)
        assert done.stdout, done.stderr
        result: dict[str, Any] = json.loads(done.stdout)
        return result

    return call
