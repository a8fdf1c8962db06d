"""Golden results for the design of flow observers: NumPy and SciPy, with dense algebra.

Run from the repository root:  python3 tests/golden/flow.py
Needs NumPy and SciPy. Writes tests/golden/flow.json.

The plants are integrated here and in the test by the same formula, so that no trajectory is stored.
Directions are chosen by the distance to the span of those chosen before, from a least-squares
problem each; the certificate's eigenvalues and weights come from full matrices.
"""

import json
import pathlib

import numpy as np
import scipy.linalg as sl

STEP = 1e-3
SAMPLES = 12000
SETTLED = 4000


def kalman(frequency, q_x, bias_bandwidth, harmonic_bandwidth, step):
    size = 2 if frequency is None else 4
    transition = np.eye(size)
    transition[0, 1] = step
    noise = [q_x, bias_bandwidth**4]
    if frequency is not None:
        c, s = np.cos(frequency * step), np.sin(frequency * step)
        transition[0, 2] = step
        transition[2:, 2:] = [[c, s], [-s, c]]
        noise += [harmonic_bandwidth**4] * 2
    output = np.eye(1, size)
    q = np.diag(noise) * step + 1e-12 * np.eye(size)
    p = sl.solve_discrete_are(transition.T, output.T, q, np.array([[1 / step]]))
    gain = transition @ p @ output.T / (output @ p @ output.T + 1 / step) / step
    return list(gain.ravel()) + [0.0] * (4 - size)


def parents(agents, edges, roots):
    """Parents and depths of one direction by relaxation until nothing changes."""
    near = [set() for _ in range(agents)]
    for a, b in edges:
        near[a].add(b)
        near[b].add(a)
    depth = [0 if i in roots else agents for i in range(agents)]
    for _ in range(agents):
        for i in range(agents):
            depth[i] = min([depth[i]] + [depth[j] + 1 for j in near[i]])
    parent = []
    for i in range(agents):
        nearer = [j for j in near[i] if depth[j] == depth[i] - 1]
        parent.append(min(nearer) if nearer else None)
    return parent, depth


def certificate(agents, edges, roots, root_gain, tree_gain, relayed):
    """Plain and weighted eigenvalue, bound, condition and weights of one direction."""
    parent, depth = parents(agents, edges, roots)
    matrix = np.zeros((agents, agents))
    for i in range(agents):
        p = parent[i]
        while relayed and p is not None and parent[p] is not None:
            p = parent[p]
        matrix[i, i] = root_gain if p is None else tree_gain
        if p is not None:
            matrix[i, p] = -tree_gain
    ones = np.ones(agents)
    u, v = np.linalg.solve(matrix, ones), np.linalg.solve(matrix.T, ones)
    half = np.diag(np.sqrt(v / u))
    weighted = half @ matrix @ np.linalg.inv(half)
    smallest = lambda m: np.linalg.eigvalsh((m + m.T) / 2)[0]
    bound = (0.5 * (1 / u + 1 / v)).min()
    return smallest(matrix), smallest(weighted), bound, (v / u).max() / (v / u).min(), list(v / u / (v / u).max())


def certificates():
    star = lambda n: [[0, i] for i in range(1, n)]
    path = lambda n: [[i, i + 1] for i in range(n - 1)]
    cases = [("star3", 3, star(3), 200.0, 500.0), ("star3", 3, star(3), 100.0, 113.0),
             ("star3", 3, star(3), 100.0, 124.0), ("star3", 3, star(3), 100.0, 37.0)]
    cases += [(f"path{n}", n, path(n), 100.0, 113.0) for n in (4, 8, 16, 32)]
    cases += [(f"hub{n}", n, star(n), 100.0, 113.0) for n in (6, 12, 24)]
    result = []
    for name, agents, edges, tree_gain, root_gain in cases:
        for relayed in (False, True):
            each = [certificate(agents, edges, {c}, root_gain, tree_gain, relayed) for c in range(3)]
            result.append({
                "name": name, "agents": agents, "edges": edges, "tree_gain": tree_gain,
                "root_gain": root_gain, "relayed": relayed,
                "plain": min(e[0] for e in each), "eigenvalue_min": min(e[1] for e in each),
                "bound": min(e[2] for e in each), "condition": max(e[3] for e in each),
                "weights": [[e[4][i] for e in each] for i in range(agents)],
            })
    return result


def lorenz(x):
    return np.array([10 * (x[1] - x[0]), x[0] * (28 - x[2]) - x[1], x[0] * x[1] - 8 / 3 * x[2]])


def duffing(x):
    return np.array([
        x[1], -0.2 * x[1] - x[0] - x[0] ** 3 + 0.5 * (x[2] - x[0]),
        x[3], -0.3 * x[3] - 0.8 * x[2] - 0.7 * x[2] ** 3 + 0.5 * (x[0] - x[2]),
    ])


def chain(x):
    rates = []
    for q in range(3):
        force = -(2 + 3 * q) * x[2 * q] - 0.04 * x[2 * q + 1]
        if q > 0:
            force += x[2 * q - 2] - x[2 * q]
        if q < 2:
            force += x[2 * q + 2] - x[2 * q]
        rates += [x[2 * q + 1], force]
    return np.array(rates)


PLANTS = {
    "lorenz": (lorenz, [1.0, 2.0, 20.0], [2.0, 3.0, 2.0]),
    "duffing": (duffing, [1.0, 0.0, -1.0, 0.5], [0.2, 1.5, 0.2, 1.2]),
    "chain": (chain, [0.5, 0.0, -0.5, 0.2, 0.3, 0.0], [0.05, 0.3, 0.05, 0.3, 0.05, 0.3]),
}


def trajectory(name):
    f, start, amplitude = PLANTS[name]
    x, states = np.array(start), []
    for k in range(SAMPLES):
        states.append(x)
        phase = np.array([(1.3 + 0.4 * c) * (k * STEP) for c in range(len(start))])
        x = x + STEP * (f(x) + np.array(amplitude) * np.sin(phase))
    return np.array(states[SETTLED:])


def first_largest(sizes):
    return next(k for k, size in enumerate(sizes) if size >= max(sizes) * (1 - 1e-9))


def directions(outputs, unit):
    """Unit rows in units of x / unit, chosen by their distance from the span of the chosen."""
    rows = [np.array(row) * unit for rows in outputs for row in rows]
    rows = [row / np.linalg.norm(row) for row in rows]
    chosen = []
    while len(chosen) < len(unit):
        distances = []
        for row in rows:
            if chosen:
                span = np.array([rows[k] for k in chosen]).T
                fit = np.linalg.lstsq(span, row, rcond=None)[0]
                distances.append(np.linalg.norm(row - span @ fit))
            else:
                distances.append(1.0)
        chosen.append(first_largest(distances))
    # By their largest component, which is positive.
    leading = lambda k: first_largest(abs(rows[k]))
    chosen.sort(key=lambda k: (leading(k), k))
    return np.array([rows[k] * np.sign(rows[k][leading(k)]) for k in chosen])


def rules(name, outputs, error, noise, modelled, scaled):
    states = trajectory(name)
    f, n = PLANTS[name][0], states.shape[1]
    deviation = states.std(0)
    unit = deviation if scaled else np.ones(n)
    rows = directions(outputs, unit)
    if scaled:
        rows = rows / (states / unit @ rows.T).std(0)[:, None]
    transform = rows / unit
    inverse = np.linalg.inv(transform)
    xi = states @ transform.T
    spread = xi.std(0)
    rates = np.diff(xi, axis=0) / STEP
    speed = np.quantile(abs(rates), 0.95, axis=0)
    model = lambda x: 1.05 * f(x) + 0.05 * deviation * np.sin(np.roll(x / deviation, -1))
    residual, slopes = np.ones(n), np.zeros((n, n))
    if modelled:
        stride = max(len(rates) // 5000, 1)
        fitted = np.array([model(x) for x in states[:-1:stride]]) @ transform.T
        some = rates[::stride]
        residual = np.quantile(abs(some - fitted), 0.95, 0) / np.quantile(abs(some), 0.95, 0)
        for x in states[::max(len(states) // 200, 1)]:
            jacobian = np.zeros((n, n))
            for j in range(n):
                step = 1e-4 * deviation[j] * np.eye(n)[j]
                jacobian[:, j] = (model(x + step) - model(x - step)) / (2 * step[j])
            slopes = np.maximum(slopes, abs(transform @ jacobian @ inverse))
    gamma = np.linalg.norm(slopes, 2)
    # In standard deviations.
    s, m = speed / spread, residual
    radius = 1.5 * error / np.linalg.norm(inverse * spread / deviation[:, None], axis=0)
    omega = 4 * s * np.sqrt(m / radius)
    sigma = noise if noise else 0.0
    if sigma:
        omega = np.minimum(omega, (3.8 * m**2 * s**4 / (sigma**2 * STEP)) ** 0.2)
    else:
        omega = np.maximum(omega, 2 * s)
    omega = np.minimum(omega, 0.25 / STEP)
    expected = np.sqrt((m * s**2 / omega**2) ** 2 + 1.06 * sigma**2 * STEP * omega)
    if sigma:
        radius = np.maximum(radius, 3 * expected)
    root = np.sqrt(2) * omega
    tree = np.minimum(np.maximum(2 * root, 1.7 * gamma), 0.9 / STEP)
    return {
        "plant": name, "outputs": outputs, "error": error, "noise": noise, "modelled": modelled,
        "scaled": scaled, "last": list(states[-1]), "transform": list(transform.ravel()),
        "speed": list(speed), "residual": list(residual), "lipschitz": gamma,
        "radius": list(radius * spread), "bandwidth": list(omega), "root_gain": list(root),
        "tree_gain": list(tree), "clip": list(3 * np.maximum(m, 1) * s * spread),
        "expected_error": list(expected * spread),
        "bias_decay": 1.0 if modelled else max(1.0, s.mean() / 2),
        "model_hold": bool(modelled and m.mean() <= 0.15),
        "passes": bool(gamma <= 0.6 * tree.min()),
    }


def random_outputs(rng, n):
    agents = int(rng.integers(4, 10))
    outputs, pool = [[] for _ in range(agents)], []
    while len(pool) < n:
        for i in rng.permutation(agents)[: agents - 1]:
            scale = rng.uniform(0.3, 3)
            if pool and rng.random() < 0.3:
                row = pool[rng.integers(len(pool))] * -scale
            else:
                row = rng.normal(size=n) * scale
                pool.append(row)
            outputs[i].append(list(row))
    return outputs


def trees(rng):
    result = []
    for _ in range(12):
        agents = int(rng.integers(2, 25))
        edges = {(int(rng.integers(k)), k) for k in range(1, agents)}
        edges |= {(i, j) for j in range(agents) for i in range(j) if rng.random() < 0.1}
        edges = [list(edge) for edge in sorted(edges)]
        roots = [sorted({int(r) for r in rng.integers(agents, size=rng.integers(1, 4))}) for _ in range(3)]
        found = [parents(agents, edges, set(r)) for r in roots]
        result.append({"agents": agents, "edges": edges, "roots": roots,
                       "parent": [f[0] for f in found], "depth": [f[1] for f in found]})
    return result


def main():
    rng = np.random.default_rng(1)
    kalman_cases = [(None, 0, 80, 0, 1e-3), (3.8, 0, 20, 20, 1e-3), (3.8, 0, 40, 20, 1e-3),
                    (3.8, 1e4, 45, 45, 1e-3), (3.0, 0, 20, 20, 1e-3), (12.0, 400, 60, 30, 1e-2),
                    (0.5, 0, 40, 10, 1e-4), (None, 0, 700, 0, 1e-3)]
    cases = []
    for name in PLANTS:
        n = len(PLANTS[name][1])
        unit = [[list(np.eye(n)[i])] for i in range(n)]
        cases.append(rules(name, unit, 0.014, None, True, True))
        cases.append(rules(name, unit, 0.014, None, False, False))
        cases.append(rules(name, unit, 0.03, None, True, False))
        for k in range(4):
            outputs = random_outputs(rng, n)
            cases.append(rules(name, outputs, 0.014, None, True, True))
            cases.append(rules(name, outputs, 0.05, 0.01, k % 2 == 0, True))
    golden = {
        "kalman": [{"arguments": case, "gains": kalman(*case)} for case in kalman_cases],
        "certificates": certificates(),
        "trees": trees(rng),
        "step": STEP, "samples": SAMPLES, "settled": SETTLED,
        "rules": cases,
    }
    file = pathlib.Path(__file__).with_suffix(".json")
    file.write_text(json.dumps(golden, default=float) + "\n")


main()
