"""Golden results for the field observer: NumPy, in double precision.

Run from the repository root:  python3 tests/golden/field.py
Needs NumPy. Writes tests/golden/field.json.

Three agents on a star observe the paper's plant, of which each measures one row. The equations are
those of docs/field-observer.md, for all agents at once: estimates, disturbances and samples are
arrays over agents and directions. A sample is kept once for its sender, and once for each
neighbour that hears it, since ends that predict differently may differ.

Initial estimates are drawn until no trigger's decision is so close that single precision could take
another one; the test then demands the same broadcasts.
"""

import json
import pathlib

import numpy as np

SINGLE = lambda x: np.asarray(x, np.float32).astype(float)
DT = float(np.float32(1e-3))
STEPS = 400
EVERY = 50
# Relative to the radius: of a fresh sample, and more for every step that it has gone on, since a constant
# rate is rounded the same way each time.
CLOSEST, EACH_STEP = 1e-4, 1e-5

AGENTS = 3
NEIGHBOURS = [[1, 2], [0], [0]]
# Who follows whom in each direction, and who is followed: the rows of S.
PARENT = np.array([[-1, 1, 2], [0, -1, 0], [0, 0, -1]])
ANNOUNCED = np.array([[1, 1, 1], [0, 1, 0], [0, 0, 1]], bool)
ROOT = PARENT < 0

OUTPUTS = np.array([[1.0, 0.0, 0.0], [0.25, 1.0, 0.0], [0.0, -0.5, 1.0]])
SCALE = np.array([0.5, 0.25, -0.5])
T = np.diag(SCALE) @ OUTPUTS
T_INVERSE = np.linalg.inv(T)

rng = np.random.default_rng(4)
WIDTHS = [3, 6, 4]
LAYERS = [(SINGLE(rng.normal(size=b) / 2), SINGLE(rng.normal(size=(a, b)) / 2)) for a, b in zip(WIDTHS, WIDTHS[1:])]
OUTER = SINGLE(rng.normal(size=(4, 3)))


def network(states):
    """f_hat of each row of states."""
    for bias, weights in LAYERS:
        states = np.tanh(states @ weights + bias)
    return states @ OUTER


def plant(x, t):
    d = np.array([0.5 * np.sin(3 * t), 0.75 * np.cos(t), np.cos(3.75 * t)])
    return x + 1e-3 * (np.array([0.3 * (x[0] - x[0] ** 3 / 3 - x[1]), x[0] / 0.3, -0.3 * x[2]]) + d)


def simulate(case, start):
    """Estimates at every tick and broadcasts, or None where a decision is too close."""
    k_o, l_b, l_p, l_q = case["gains"]
    frequency = case["frequency"]
    cosine, sine = SINGLE(np.cos(frequency * DT)), SINGLE(np.sin(frequency * DT))
    clip, radius, kept = case["clip"], case["radius"], case["bias_kept"]
    low, high = np.array(case["low"]), np.array(case["high"])
    digests = case["digests"] if case["network"] else [0] * AGENTS
    shared = np.array([[digests[i] == digests[j] for j in range(AGENTS)] for i in range(AGENTS)])

    def flow(states):
        return network(np.clip(states, low, high)) if case["network"] else np.zeros_like(states)

    def turn(model):
        # p and q stay within the clip one by one, in samples as in agents.
        b, p, q = np.moveaxis(model, -1, 0)
        turned = np.stack([cosine * p + sine * q, cosine * q - sine * p], -1)
        return np.concatenate([b[..., None], np.clip(turned, -clip, clip)], -1)

    def level(model):
        return np.clip(model[..., 0] + model[..., 1], -clip, clip)

    x = np.array([5.0, 7.0, 8.0])
    estimate = start.copy()
    model = np.zeros((AGENTS, 3, 3))
    # What agent i has of agent j: sample, its model, rate, kind; the own sample is that with i = j.
    sample = np.zeros((AGENTS, AGENTS, 3))
    carried = np.zeros((AGENTS, AGENTS, 3, 3))
    rate = np.zeros((AGENTS, AGENTS, 3))
    kind = np.full((AGENTS, AGENTS), "", dtype=object)
    waiting, ticks, course = [], [[] for _ in range(AGENTS)], []
    for k in range(STEPS):
        for j, frame in waiting:
            for i in NEIGHBOURS[j]:
                sample[i, j], carried[i, j], rate[i, j], kind[i, j] = frame
        waiting = []

        y = OUTPUTS @ x
        xi = estimate @ T.T
        nu = np.where(ROOT, SCALE * y - xi, 0.0)
        push = k_o * nu + np.where(ROOT, level(model), 0.0)
        for i in range(AGENTS):
            for c in range(3):
                parent = PARENT[i, c]
                if parent >= 0 and kind[i, parent]:
                    push[i, c] += case["tree_gain"] * (T[c] @ sample[i, parent] - xi[i, c])
                    push[i, c] += level(carried[i, parent, c])
        course.append(estimate.copy())
        estimate = estimate + DT * (flow(estimate) + push @ T_INVERSE.T)
        model = turn(model) + DT * nu[..., None] * np.array([l_b, l_p, l_q])
        model = np.where(ROOT[..., None], np.clip(model, -clip, clip), 0.0)
        x = plant(x, 1e-3 * k)

        # Samples go on.
        for i in range(AGENTS):
            for j in range(AGENTS):
                if kind[i, j] in ("", "zero-order"):
                    speed = None
                elif kind[i, j] == "rate":
                    speed = rate[i, j]
                else:
                    known = flow(sample[i, j][None])[0] if shared[i, j] else 0.0
                    speed = known + T_INVERSE @ level(carried[i, j])
                if speed is not None:
                    sample[i, j] = np.clip(sample[i, j] + DT * speed, low, high)
                carried[i, j] = turn(carried[i, j])
                carried[i, j, :, 0] *= kept

        # Broadcasts for the next tick.
        for i in range(AGENTS):
            heard = [j for j in NEIGHBOURS[i] if kind[i, j]]
            agree = all(shared[i, j] for j in heard)
            aim, limit = estimate[i] @ T.T, np.full(3, radius)
            said = model[i].copy()
            for c in range(3):
                parent = PARENT[i, c]
                if parent in heard:
                    aim_c = T[c] @ sample[i, parent]
                    limit[c] = case["relay_share"] * radius
                    said[c] = carried[i, parent, c]
                    aim[c] = aim_c if ANNOUNCED[i, c] else aim[c]
            if kind[i, i]:
                share = (abs(T @ sample[i, i] - aim) / limit)[ANNOUNCED[i]].max()
                due = share >= 1 or (kind[i, i] == "model" and not agree)
                if abs(share - 1) < CLOSEST + EACH_STEP * (k + 1 - ticks[i][-1]):
                    return None
            else:
                due = True
            if not due:
                continue
            content = estimate[i] + T_INVERSE @ (aim - T @ estimate[i])
            hold = case["hold"]
            if hold == "model" and not (agree and case["network"]):
                hold = "rate"
            speed = np.zeros(3)
            if hold == "rate":
                speed = flow(content[None])[0] + T_INVERSE @ level(said)
            has_model = l_b > 0
            said = np.where(ANNOUNCED[i][:, None] & has_model, said, 0.0)
            frame = (content, said, speed, hold)
            sample[i, i], carried[i, i], rate[i, i], kind[i, i] = frame
            waiting.append((i, frame))
            ticks[i].append(k + 1)
    return np.array(course), ticks, abs(course[-1] - x).max()


ESO = [113.0, 6048.0, 0.0, 0.0]
HARMONIC = [59.0, 1554.0, 123.0, 535.0]
CASES = {
    "zero-order, no model": {"hold": "zero-order", "gains": [200.0, 0.0, 0.0, 0.0], "network": False},
    "rate, bias, no network": {"hold": "rate", "gains": ESO, "network": False},
    "rate, harmonic": {"hold": "rate", "gains": HARMONIC},
    "model, bias": {"hold": "model", "gains": ESO},
    "model, harmonic": {"hold": "model", "gains": HARMONIC},
    "model, another network at agent 3": {"hold": "model", "gains": HARMONIC, "digests": [7, 7, 8]},
    "model, narrow limits": {"hold": "model", "gains": ESO, "high": [30.0, 30.0, 7.0]},
}


def main():
    result = {}
    for name, given in CASES.items():
        harmonic = given["gains"] is HARMONIC
        case = {
            "network": True, "digests": [7, 7, 7], "frequency": 3.8 if harmonic else 0.0,
            "clip": 6.0 if given["gains"][1] else 0.0, "radius": float(np.float32(0.05)), "tree_gain": 150.0,
            "relay_share": float(np.float32(0.9)), "bias_kept": float(np.float32(0.999)),
            "low": [-30.0] * 3, "high": [30.0] * 3, **given,
        }
        for draw in range(1000):
            start = SINGLE(np.random.default_rng(draw).normal(size=(AGENTS, 3)))
            found = simulate(case, start)
            if found is not None:
                break
        course, ticks, error = found
        print(f"{name}: draw {draw}, {[len(t) for t in ticks]} broadcasts, last error {error:.4f}")
        result[name] = {
            **case, "start": start.ravel().tolist(), "broadcasts": ticks,
            "estimates": [[float(f"{x:.9g}") for x in row.ravel()] for row in course[EVERY::EVERY]],
        }
    golden = {
        "steps": STEPS, "every": EVERY, "outputs": OUTPUTS.tolist(), "scale": SCALE.tolist(),
        "transform": T.ravel().tolist(), "inverse": T_INVERSE.ravel().tolist(),
        "parents": PARENT.tolist(), "announced": ANNOUNCED.tolist(), "neighbours": NEIGHBOURS,
        "widths": WIDTHS[1:], "inner": [x for b, w in LAYERS for x in [*b, *w.ravel()]],
        "outer": OUTER.ravel().tolist(), "cases": result,
    }
    file = pathlib.Path(__file__).with_suffix(".json")
    file.write_text(json.dumps(golden) + "\n")


main()
