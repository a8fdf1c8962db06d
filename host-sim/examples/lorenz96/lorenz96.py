#!/usr/bin/env python3
"""Makes the scenario and the golden data of the Lorenz-96 example.

The plant and its settings are those of DAPPER (MIT licence), `dapper.mods.Lorenz96.sakov2008`: 40 states,
F = 8, every state measured every 0.05 with a variance of 1. Here 20 agents measure two states each.

    python3 -m venv venv
    venv/bin/pip install dapper==1.7.1
    venv/bin/python host-sim/examples/lorenz96/lorenz96.py

writes golden-12.csv and golden-40.csv, DAPPER's own steps of 0.05 from its own initial state, and
lorenz96.toml.
"""

from pathlib import Path

import numpy as np
from dapper.mods.Lorenz96 import step, x0
from dapper.mods.Lorenz96.sakov2008 import HMM, Nx

FOLDER = Path(__file__).parent
STATES = Nx
AGENTS = 20
PERIOD = HMM.tseq.dto  # between observations
SPIN_UP = 400  # steps of the period until the state is on the attractor


def golden(states: int, steps: int, every: int) -> None:
    """Writes every `every`-th of the states that DAPPER's model passes through."""
    x = x0(states)
    lines = ["t," + ",".join(f"x{i + 1}" for i in range(states))]
    for k in range(steps + 1):
        if k % every == 0:
            lines.append(",".join(repr(float(v)) for v in [k * PERIOD, *x]))
        x = step(x, np.nan, PERIOD)
    (FOLDER / f"golden-{states}.csv").write_text("\n".join(lines) + "\n")


def name(i: int) -> str:
    return f"x{i % STATES + 1}"


def row(i: int) -> str:
    return "[" + ", ".join("1.0" if c == i else "0.0" for c in range(STATES)) + "]"


def scenario() -> str:
    """Returns the scenario."""
    x = x0(STATES)
    for _ in range(SPIN_UP):
        x = step(x, np.nan, PERIOD)
    noise = HMM.Obs(0).noise.C.full if callable(HMM.Obs) else HMM.Obs.noise.C.full
    assert np.array_equal(noise, np.eye(STATES)), "another version has other settings"
    derivative = [
        f'    "({name(i + 1)} - {name(i - 2)})*{name(i - 1)} - {name(i)} + F",' for i in range(STATES)
    ]
    edges = [f"[{i + 1}, {(i + d) % AGENTS + 1}]" for i in range(AGENTS) for d in (1, 2)]
    agents = [
        f"[[agents]]\noutput_matrix = [\n    {row(2 * i)},\n    {row(2 * i + 1)},\n]\n"
        for i in range(AGENTS)
    ]
    newline = "\n"
    return f"""\
# Lorenz-96 with DAPPER's settings: {STATES} states, each measured every {PERIOD} with a standard deviation of 1, two
# by each of 20 agents, which hear their two neighbours on both sides. Made by lorenz96.py; needs a build
# with `--features wide`. docs/researcher.md has the results.

name = "lorenz96"

[plant]
model = "expressions"
states = [{", ".join(f'"{name(i)}"' for i in range(STATES))}]
parameters = {{ F = 8.0 }}
derivative = [
{newline.join(derivative)}
]
# On the attractor: after {SPIN_UP} of DAPPER's steps.
initial_state = [
    {", ".join(repr(round(float(v), 6)) for v in x)},
]

[time]
duration = 30.0
step = 0.002
plant_integrator = "rk4"

[sensor]
noise = 1.0
period = {PERIOD}

# The step is half of the largest stable one. Theorem 1 promises nothing here: the gain is too small for the plant's
# growth, and measurements have noise.
[design]
gain = 80.0
k2 = 2.0
kappa = 1.0
rho = 30.0
delta = 100.0
epsilon = 100000.0

[network]
layers = [{{ nodes = 24, activation = "tanh" }}]
inner = {{ random = "glorot" }}
outer = {{ random = 1.0 }}

[outer_law]
gain = 0.1
bound = 200.0

[graph]
edges = [
    {("," + newline + "    ").join(", ".join(edges[k : k + 8]) for k in range(0, len(edges), 8))},
]

{newline.join(agents)}
[[learning]]
collect_from = 5.0
collect_to = 10.0
stride = 5
apply_at = 10.0
recipe = "small"
shared = true

[recipes.small]
epochs = 20
weight_decay = 1e-2

[evaluation]
from = 20.0
"""


if __name__ == "__main__":
    golden(12, 100, 5)
    golden(STATES, 100, 5)
    (FOLDER / "lorenz96.toml").write_text(scenario())
