"""Golden results of the study that the field observer comes from: its own engine runs these cases.

Run from the repository root:  python3 tests/golden/study.py FOLDER
FOLDER holds the study's general engine (`eng.py`, `lib.py`), which is not part of this repository.
Needs NumPy, SciPy and Numba. Writes tests/golden/study.json.

Each case is a random geometry of one of the study's plants: rows that are neither of unit length nor
orthogonal, some measured by several agents, some agents that measure nothing. Transform, trees,
radii and gains are the study's, for an error of 0.014, and so are the results: broadcasts and RMS
error of each agent, in units of the components' standard deviations, in the first 0.8 s and from
2 s to 8 s.

Estimates start at the plant's state and every agent broadcasts at once, as the project's agents do.
A loss that never happens makes the engine keep each receiver's own copy of a sample, and deliver
frames after all agents have decided.
"""

import json
import pathlib
import sys

import numpy as np

FOLDER = pathlib.Path(sys.argv[1])
sys.path.insert(0, str(FOLDER))
import eng  # noqa: E402
import lib  # noqa: E402

EARLY, STEPS, FROM = 800, 8000, 2000
ERROR = 0.014
SHARE = 0.9
NEVER = 1e-300
# Frames of the project carry 6 states, their rates and the disturbance of 4 directions, or less; without
# rates, of all. So Lorenz-96 is here without a model, of whose agents most announce all directions.
ANNOUNCED_MAX = 4
# The study's gate: the largest share of the tree gain that the model's slope may have.
GATE = 0.6
# Plant, what is known of f (0 nothing, 1 about 5 % off, 2 all), hold (0 zero-order, 1 model, 2 rate), first draw.
CASES = [
    (0, 1, 1, 2), (0, 0, 2, 3), (1, 1, 1, 1), (1, 1, 2, 4), (1, 0, 0, 2), (2, 1, 1, 1), (2, 0, 2, 1),
    (3, 2, 1, 1), (3, 1, 2, 2), (4, 0, 0, 2),
]


def motion(plant, seed):
    """The draws of the study's `plant`, which returns the trajectory only."""
    rng = np.random.default_rng(seed)
    n = lib.DIM[plant]
    start = {
        0: lambda: rng.uniform([-10, -10, 15], [10, 10, 30]),
        1: lambda: rng.uniform(-2, 2, 4),
        2: lambda: rng.uniform(-1.5, 1.5, 6),
        3: lambda: rng.uniform(-1, 1, 6),
        4: lambda: 8 + rng.normal(size=6) * 2,
    }[plant]()
    return start, rng.uniform(1.0, 4.0, n), rng.uniform(0, 6.28, n)


def geometry(plant, knowledge, hold, first):
    """The first random geometry that qualifies: draw, rows, graph, the study's case, announced directions, rules."""
    for draw in range(first, first + 100):
        rng = np.random.default_rng(100 * plant + draw)
        agents = int(rng.integers(4, 10))
        graph = lib.rgraph(agents, rng)
        rows = lib.rrows(lib.DIM[plant], agents, rng)
        case = lib.case(plant, graph, rows, seed=draw, T=20.0)
        announced = np.zeros((agents, lib.DIM[plant]), bool)
        for i, c in zip(*np.nonzero(case["par"] >= 0)):
            announced[case["par"][i, c], c] = True
        if hold != 0 and announced.sum(axis=1).max() > ANNOUNCED_MAX:
            continue
        slope = lib.gamma(case, knowledge)
        rules = lib.rules(case, ERROR, lib.resid(case, knowledge), gam=slope)
        if slope <= GATE * rules["Kc"].min():
            return draw, rows, graph, case, announced, rules
    raise ValueError(f"no geometry of {lib.NAMES[plant]}")


def main():
    cases = []
    for plant, knowledge, hold, first in CASES:
        draw, rows, graph, case, announced, rules = geometry(plant, knowledge, hold, first)
        agents = len(graph)
        start, frequencies, phases = motion(plant, draw)
        trajectory = case["p"]["X"]
        assert np.array_equal(trajectory[0], start)

        def outcome(first, last):
            settings = {"hold": hold, "fwd": SHARE, "loss": NEVER, "maxg": 99999, "k1": last,
                        "xh": np.tile(start, (agents, 1))}
            found = lib.sim(case, {**rules, **settings}, knowledge, kw=first)
            counts = np.rint(found["cnt"] * (last - first) * lib.DT).astype(int)
            return {"broadcasts": counts.tolist(), "errors": found["ag"].tolist()}

        early, late = outcome(0, EARLY), outcome(FROM, STEPS)
        dimension = lib.DIM[plant]
        outputs = []
        for i in range(agents):
            found = []
            for c in range(dimension):
                which = None
                for k, row in enumerate(rows[i]):
                    scale = case["T"][c] @ row / (row @ row)
                    if case["root"][i, c] and np.allclose(scale * row, case["T"][c]):
                        which = [k, scale]
                        break
                found.append(which)
            outputs.append(found)
        print(f"{lib.NAMES[plant]}, {agents} agents: {late['broadcasts']} broadcasts")
        amplitude = (case["p"]["D"] / np.sin(np.arange(20000)[:, None] * lib.DT * frequencies + phases))[7]
        cases.append({
            "plant": lib.NAMES[plant], "knowledge": ["none", "near", "all"][knowledge],
            "hold": ["zero-order", "model", "rate"][hold], "start": start.tolist(),
            "amplitudes": amplitude.tolist(), "frequencies": frequencies.tolist(), "phases": phases.tolist(),
            "deviations": case["p"]["xs"].tolist(), "distortion": case["p"]["fp"].tolist(),
            "graph": [np.flatnonzero(row).tolist() for row in graph],
            "outputs": [[row.tolist() for row in of_agent] for of_agent in rows], "roots": outputs,
            "parents": case["par"].tolist(), "announced": announced.tolist(),
            "transform": case["T"].tolist(), "inverse": case["Ti"].tolist(),
            **{name: np.broadcast_to(rules[key], dimension).tolist() for name, key in
               [("radii", "r"), ("tree_gains", "Kc"), ("root_gains", "ko"), ("bandwidths", "wb"), ("clips", "bmax")]},
            "early": early, "late": late,
        })
    golden = {"early_steps": EARLY, "steps": STEPS, "from": FROM, "relay_share": SHARE, "bias_kept": 1 - lib.DT, "cases": cases}
    file = pathlib.Path(__file__).with_suffix(".json")
    file.write_text(json.dumps(golden, separators=(",", ":")) + "\n")


main()
