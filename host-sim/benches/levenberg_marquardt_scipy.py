"""Measures SciPy's Levenberg-Marquardt on a problem of the benchmark's size, in seconds per iteration.

    pip install numpy scipy
    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python3 host-sim/benches/levenberg_marquardt_scipy.py

The network has the paper's shape (3-12-12-12-5, tanh, then fixed outer weights to 3 outputs): 425
parameters, 4,200 samples, 12,600 residuals. The Jacobian is analytic. An iteration is the time
between two evaluations of the Jacobian.
"""

import time

import numpy as np
from scipy.optimize import least_squares

WIDTHS = [3, 12, 12, 12, 5]
rng = np.random.default_rng(0)
x = rng.uniform(-2, 2, (4200, 3))
y = np.column_stack([x[:, 0] - x[:, 0] ** 3 / 3 - x[:, 1], x[:, 0] * 3, -0.3 * x[:, 2]])
outer = rng.uniform(-4, 4, (5, 3))
shapes = list(zip(WIDTHS, WIDTHS[1:]))
start = np.concatenate(
    [
        np.concatenate([np.zeros(n), rng.normal(0, 1 / np.sqrt(m), m * n)])
        for m, n in shapes
    ]
)


def forward(parameters):
    activations, position = [x], 0
    for m, n in shapes:
        bias = parameters[position : position + n]
        weights = parameters[position + n : position + n + m * n].reshape(m, n)
        position += n + m * n
        activations.append(np.tanh(activations[-1] @ weights + bias))
    return activations


def residuals(parameters):
    return (forward(parameters)[-1] @ outer - y).ravel()


def jacobian(parameters):
    activations = forward(parameters)
    samples = len(x)
    blocks, end = [], len(parameters)
    # delta[s, o, node]: derivative of output o with respect to the weighted sum of a node.
    delta = outer.T[None] * (1 - activations[-1] ** 2)[:, None, :]
    for layer in reversed(range(len(shapes))):
        m, n = shapes[layer]
        below = activations[layer]
        weights = parameters[end - m * n : end].reshape(m, n)
        by_weight = np.einsum("sm,son->somn", below, delta).reshape(samples, 3, m * n)
        blocks.insert(0, np.concatenate([delta, by_weight], axis=2))
        end -= n + m * n
        if layer:
            delta = (delta @ weights.T) * (1 - below**2)[:, None, :]
    return np.concatenate(blocks, axis=2).reshape(samples * 3, -1)


numeric = (residuals(start + 1e-6 * np.eye(len(start))[200]) - residuals(start)) / 1e-6
assert np.allclose(jacobian(start)[:, 200], numeric, atol=1e-4)

starts = []


def timed_jacobian(parameters):
    starts.append(time.perf_counter())
    return jacobian(parameters)


least_squares(residuals, start, timed_jacobian, method="lm", max_nfev=12)
iterations = np.diff(starts)
print(f"SciPy, seconds per iteration: median {np.median(iterations):.3f} of {len(iterations)}")
