"""Golden results for the Levenberg-Marquardt solver: SciPy's least_squares(method="lm").

Run from the repository root:  python3 tests/golden/levenberg_marquardt.py
Needs NumPy and SciPy. Writes tests/golden/levenberg_marquardt.json.

Problems: More, Garbow and Hillstrom, "Testing unconstrained optimization software", ACM TOMS
7(1), 1981; Misra1a from NIST's Statistical Reference Datasets for nonlinear regression. Data
that a problem needs are written into the file, so that the test reads them from there.
"""

import json
import pathlib

import numpy as np
import scipy
from scipy.optimize import least_squares

OSBORNE_1 = [
    0.844, 0.908, 0.932, 0.936, 0.925, 0.908, 0.881, 0.850, 0.818, 0.784, 0.751,
    0.718, 0.685, 0.658, 0.628, 0.603, 0.580, 0.558, 0.538, 0.522, 0.506, 0.490,
    0.478, 0.467, 0.457, 0.448, 0.438, 0.431, 0.424, 0.420, 0.414, 0.411, 0.406,
]
MISRA1A_X = [77.6, 114.9, 141.1, 190.8, 239.9, 289.0, 332.8, 378.4, 434.8, 477.3, 536.8, 593.1,
             689.1, 760.0]
MISRA1A_Y = [10.07, 14.73, 17.94, 23.93, 29.61, 35.18, 40.02, 44.82, 50.76, 55.05, 61.01, 66.40,
             75.47, 81.78]


def rosenbrock(x, _):
    return [10 * (x[1] - x[0] ** 2), 1 - x[0]]


def powell_singular(x, _):
    return [x[0] + 10 * x[1], np.sqrt(5) * (x[2] - x[3]), (x[1] - 2 * x[2]) ** 2,
            np.sqrt(10) * (x[0] - x[3]) ** 2]


def helical_valley(x, _):
    angle = np.arctan(x[1] / x[0]) / (2 * np.pi) + (0.5 if x[0].real < 0 else 0)
    return [10 * (x[2] - 10 * angle), 10 * (np.sqrt(x[0] ** 2 + x[1] ** 2) - 1), x[2]]


def freudenstein_roth(x, _):
    return [-13 + x[0] + ((5 - x[1]) * x[1] - 2) * x[1],
            -29 + x[0] + ((x[1] + 1) * x[1] - 14) * x[1]]


def brown_dennis(x, _):
    t = np.arange(1, 21) / 5
    return (x[0] + t * x[1] - np.exp(t)) ** 2 + (x[2] + x[3] * np.sin(t) - np.cos(t)) ** 2


def osborne_1(x, data):
    t = 10 * np.arange(33)
    return np.array(data["y"]) - (x[0] + x[1] * np.exp(-t * x[3]) + x[2] * np.exp(-t * x[4]))


def misra1a(x, data):
    return np.array(data["y"]) - x[0] * (1 - np.exp(-x[1] * np.array(data["x"])))


PROBLEMS = [
    (rosenbrock, [-1.2, 1.0], {}),
    (powell_singular, [3.0, -1.0, 0.0, 1.0], {}),
    (helical_valley, [-1.0, 0.0, 0.0], {}),
    (freudenstein_roth, [0.5, -2.0], {}),
    (brown_dennis, [25.0, 5.0, -5.0, -1.0], {}),
    (osborne_1, [0.5, 1.5, -1.0, 0.01, 0.02], {"y": OSBORNE_1}),
    (misra1a, [250.0, 0.0005], {"x": MISRA1A_X, "y": MISRA1A_Y}),
]


def jacobian(residuals, x, data):
    """By complex steps: exact to within rounding error."""
    step = 1e-30
    columns = [
        np.imag(residuals(x + 1j * step * unit, data)) / step for unit in np.eye(len(x))
    ]
    return np.transpose(columns)


def solve(residuals, start, data):
    solution = least_squares(
        lambda x: np.asarray(residuals(x, data)), start, method="lm",
        jac=lambda x: jacobian(residuals, x, data),
        x_scale="jac", ftol=1e-15, xtol=1e-15, gtol=1e-15, max_nfev=100_000,
    )
    return {
        "name": residuals.__name__,
        "start": start,
        "data": data,
        "solution": solution.x.tolist(),
        "sum_of_squares": 2 * solution.cost,
        "residuals": len(solution.fun),
    }


def main():
    result = {
        "script": "tests/golden/levenberg_marquardt.py",
        "scipy": scipy.__version__,
        "problems": [solve(*problem) for problem in PROBLEMS],
    }
    path = pathlib.Path(__file__).with_suffix(".json")
    path.write_text(json.dumps(result, indent=1) + "\n")
    for problem in result["problems"]:
        print(problem["name"], problem["solution"], problem["sum_of_squares"])


main()
