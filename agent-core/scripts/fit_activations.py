#!/usr/bin/env python3
"""Fits the constants of agent-core/inner-network/src/activation.rs and prints them.

    pip install numpy mpmath
    python agent-core/scripts/fit_activations.py
    python agent-core/scripts/fit_activations.py --golden

The second form also prints the hashes and bits that `inner-network/src/activation/tests.rs` expects,
computed with the binary32 model below, not with the Rust code.

Each polynomial is fitted in two steps, without randomness:

1. A Remez exchange in 40 digits finds the polynomial with the smallest maximum *weighted*
   error. The weight is the derivative of the activation's relative error with respect to
   the polynomial, so the error of the activation is minimised, not that of the polynomial.
   Coefficients are rounded to binary32 one by one, lowest degree first; after each
   rounding the remaining ones are fitted again.
2. A descent over neighbouring binary32 values minimises the worst error of the whole
   function, evaluated operation by operation in binary32 on a fixed grid of inputs.

The search uses only a grid. `cargo run --release --example activation_error` checks every
float and determines the documented errors.
"""

import sys

import mpmath as mp
import numpy as np

mp.mp.dps = 40
F32 = np.float32

LN2 = mp.log(2)
# Below this tanh is x - x^3 P(x^2), above it 1 - 2 / (exp(2 x) + 1). Just above
# atanh(1/2) = 0.5493, so that the second form never gives a result in the binade below 1/2.
TANH_SMALL_BELOW = F32(0.55)
# 1 - tanh(x) is under a quarter of an ulp from here on.
TANH_FIT_END = mp.mpf("9.4")
# Doublings of the argument from x / 4 to 2 x.
TANH_DOUBLINGS = 3
# exp(-104) is less than half of the smallest subnormal, 2^-150.
EXP_LIMIT = F32(104.0)
# The same for exp(-x^2): 10.2^2 = 104.04.
GAUSSIAN_LIMIT = F32(10.2)
# 1 + exp(-20) is 1.
LOGISTIC_SATURATION = F32(20.0)
# 1.5 * 2^23: adding it to a number leaves the nearest integer in the low bits.
ROUNDER = F32(12582912.0)
LOG2_E = F32(float(1 / LN2))
# 16 bits, so that its product with any |k| <= 151 (8 bits) is exact.
LN2_HIGH = F32(float(mp.nint(LN2 * 2**16) / 2**16))
LN2_LOW = F32(float(LN2 - mp.mpf(float(LN2_HIGH))))


def remez(target, weight, first_degree, last_degree, low, high, grid_size=600):
    """Minimises max |weight (p - target)| for p = sum of c_j v^j over the degrees given."""
    degrees = range(first_degree, last_degree + 1)
    unknowns = len(degrees)

    def chebyshev(i, n):
        return low + (high - low) * (1 - mp.cos(mp.pi * mp.mpf(i) / n)) / 2

    grid = [chebyshev(i, grid_size) for i in range(grid_size + 1)]
    targets = [target(v) for v in grid]
    weights = [weight(v) for v in grid]
    nodes = [round(grid_size * i / unknowns) for i in range(unknowns + 1)]
    for _ in range(30):
        matrix = mp.matrix(unknowns + 1, unknowns + 1)
        right = mp.matrix(unknowns + 1, 1)
        for row, node in enumerate(nodes):
            shift = 1 if grid[node] == 0 or weights[node] == 0 else 0
            v, w, t = grid[node + shift], weights[node + shift], targets[node + shift]
            for column, degree in enumerate(degrees):
                matrix[row, column] = v**degree
            matrix[row, unknowns] = (-1) ** row / w
            right[row] = t
        solution = mp.lu_solve(matrix, right)
        coefficients = [solution[j] for j in range(unknowns)]
        level = abs(solution[unknowns])
        errors = [
            w * (sum(c * v**d for c, d in zip(coefficients, degrees)) - t)
            for v, w, t in zip(grid, weights, targets)
        ]
        extrema = []
        for i, error in enumerate(errors):
            if extrema and mp.sign(error) == mp.sign(errors[extrema[-1]]):
                if abs(error) > abs(errors[extrema[-1]]):
                    extrema[-1] = i
            elif error != 0:
                extrema.append(i)
        while len(extrema) > unknowns + 1:
            extrema.pop(0 if abs(errors[extrema[0]]) < abs(errors[extrema[-1]]) else -1)
        worst = max(abs(errors[i]) for i in extrema)
        if len(extrema) < unknowns + 1 or worst < level * mp.mpf("1.001"):
            return coefficients, worst
        nodes = extrema
    return coefficients, worst


def rounded_fit(target, weight, degree, low, high):
    """Rounds the coefficients to binary32 in turn, refitting those that are still free."""
    _, unrounded_error = remez(target, weight, 0, degree, low, high)
    fixed = []
    for first in range(degree + 1):

        def rest(v):
            return target(v) - sum(mp.mpf(float(c)) * v**j for j, c in enumerate(fixed))

        free, _ = remez(rest, weight, first, degree, low, high)
        fixed.append(F32(float(free[0])))
    return fixed, unrounded_error


def ulp_error(values, reference):
    """Distance to the unrounded reference in ulps of the reference's binade."""
    exponent = np.floor(np.log2(np.abs(reference)))
    unit = np.exp2(np.maximum(exponent, -126.0) - 23.0)
    return np.abs(values.astype(np.float64) - reference) / unit


def descend(coefficients, worst_error):
    """Coordinate descent over neighbouring binary32 values, at most three ulps a step."""
    best = worst_error(coefficients)
    improved = True
    while improved:
        improved = False
        for index in range(len(coefficients)):
            for step in (-3, -2, -1, 1, 2, 3):
                trial = list(coefficients)
                bits = trial[index].view(np.int32) + np.int32(step)
                trial[index] = bits.view(np.float32)
                error = worst_error(trial)
                if error < best - 1e-9:
                    best, coefficients, improved = error, trial, True
    return coefficients, best


def horner(coefficients, v):
    value = np.full_like(v, coefficients[-1])
    for c in coefficients[-2::-1]:
        value = value * v + c
    return value


# tanh(x) = x - x (t P(t)), t = x^2.
def tanh_small(x, coefficients):
    t = x * x
    return x - x * (t * horner(coefficients, t))


def fit_tanh_small():
    def target(t):
        x = mp.sqrt(t)
        return (x - mp.tanh(x)) / (x * t)

    def weight(t):
        x = mp.sqrt(t)
        return x * t / mp.tanh(x)

    end = mp.mpf(float(TANH_SMALL_BELOW))
    start, unrounded = rounded_fit(target, weight, 3, mp.mpf("1e-6"), end**2)
    x = np.linspace(2.0**-6, float(TANH_SMALL_BELOW), 200_001).astype(F32)
    reference = np.tanh(x.astype(np.float64))
    return *descend(start, lambda c: ulp_error(tanh_small(x, c), reference).max()), unrounded


# expm1(z) = z + z^2 Q(z) at z = x / 4, then expm1(2 v) = m (m + 2) with m = expm1(v).
def tanh_large(x, coefficients):
    z = F32(0.25) * x
    m = z + (z * z) * horner(coefficients, z)
    for _ in range(TANH_DOUBLINGS):
        m = m * (m + F32(2))
    return F32(1) - F32(2) / (m + F32(2))


def fit_tanh_large():
    def target(z):
        return (mp.expm1(z) - z) / z**2

    def weight(z):
        x = 4 * z
        e = mp.exp(2 * x)
        slope = 2**TANH_DOUBLINGS * e / mp.exp(z)
        return z**2 * slope * 2 / (e + 1) ** 2 / mp.tanh(x)

    low = mp.mpf(float(TANH_SMALL_BELOW)) / 4
    start, unrounded = rounded_fit(target, weight, 4, low, TANH_FIT_END / 4)
    x = np.concatenate(
        [np.linspace(float(TANH_SMALL_BELOW), 1.5, 300_001), np.linspace(1.5, 9.5, 50_001)]
    ).astype(F32)
    reference = np.tanh(x.astype(np.float64))
    return *descend(start, lambda c: ulp_error(tanh_large(x, c), reference).max()), unrounded


# exp(high + tail) = 2^k (1 + (r + r^2 R(r))), r = (high + tail) - k ln 2.
def exp(high, tail, coefficients):
    k = ((high + tail) * LOG2_E + ROUNDER) - ROUNDER
    r = (high - k * LN2_HIGH) + (tail - k * LN2_LOW)
    p = F32(1) + (r + (r * r) * horner(coefficients, r))
    return np.ldexp(p.astype(np.float64), k.astype(np.int64)).astype(F32)


def fit_exp():
    half = LN2 / 2 * mp.mpf("1.0005")  # k is rounded in binary32, so r can pass ln 2 / 2

    def target(r):
        return (mp.expm1(r) - r) / r**2 if abs(r) > mp.mpf("1e-9") else mp.mpf(1) / 2

    def weight(r):
        return r**2 / mp.exp(r)

    start, unrounded = rounded_fit(target, weight, 4, -half, half)
    y = np.linspace(-20.0, 0.0, 300_001).astype(F32)
    reference = np.exp(y.astype(np.float64))
    zero = F32(-0.0)
    return *descend(start, lambda c: ulp_error(exp(y, zero, c), reference).max()), unrounded


def tanh(x, small, large):
    a = np.abs(x)
    value = np.where(a < TANH_SMALL_BELOW, tanh_small(a, small), tanh_large(a, large))
    return np.copysign(value, x)


# Both scale the exponential by a power of two until the last operation.
SCALE = F32(2.0**-64)


def exp_scaled(high, tail, exponent, coefficients):
    rounded = (high + tail) * LOG2_E + ROUNDER
    k = rounded - ROUNDER
    r = (high - k * LN2_HIGH) + (tail - k * LN2_LOW)
    p = F32(1) + (r + (r * r) * horner(coefficients, r))
    return p * np.exp2(k + F32(exponent)).astype(F32)


def logistic(x, coefficients):
    y = -np.clip(x, -EXP_LIMIT, LOGISTIC_SATURATION)
    return SCALE / (SCALE + exp_scaled(y, F32(-0.0), -64, coefficients))


def gaussian(x, coefficients):
    a = np.minimum(np.abs(x), GAUSSIAN_LIMIT)
    head = (a.view(np.uint32) & np.uint32(0xFFFFF000)).view(F32)
    tail = (a - head) * (a + head)
    return exp_scaled(-(head * head), -tail, 64, coefficients) * SCALE


def fnv1a(data):
    value = 0xCBF29CE484222325
    for byte in data:
        value = ((value ^ byte) * 0x100000001B3) % 2**64
    return value


def print_golden(small, large, exponential):
    """The same 100,000 inputs as `sample_bits` in tests.rs."""
    spread = (np.arange(100_000, dtype=np.uint64) * np.uint64(0x9E3779B9)) % np.uint64(2**32)
    bits = (spread >> np.uint64(1)) % np.uint64(0x43000000)
    bits |= (spread << np.uint64(31)) & np.uint64(0x80000000)
    x = bits.astype(np.uint32).view(F32)
    for name, values in (
        ("tanh", tanh(x, small, large)),
        ("logistic", logistic(x, exponential)),
        ("Gaussian", gaussian(x, exponential)),
    ):
        print(f"{name}: {fnv1a(values.astype(F32).tobytes()):#018x}")
    for x in (0.1, 0.54, 0.55, 1.0, -2.5, 9.0):
        value = tanh(np.array([x], dtype=F32), small, large)
        print(f"tanh({x}): {int(value.view(np.uint32)[0]):#010x}")


def show(name, value):
    bits = int(F32(value).view(np.uint32))
    print(f"{name} = {np.format_float_positional(F32(value), unique=True)}  # {bits:#010x}")


def main():
    show("TANH_SMALL_BELOW", TANH_SMALL_BELOW)
    show("EXP_LIMIT", EXP_LIMIT)
    show("GAUSSIAN_LIMIT", GAUSSIAN_LIMIT)
    show("ROUNDER", ROUNDER)
    show("LOG2_E", LOG2_E)
    show("LN2_HIGH", LN2_HIGH)
    show("LN2_LOW", LN2_LOW)
    show("LOGISTIC_SATURATION", LOGISTIC_SATURATION)
    fitted = []
    for name, fit in (
        ("TANH_SMALL", fit_tanh_small),
        ("TANH_LARGE", fit_tanh_large),
        ("EXP", fit_exp),
    ):
        coefficients, on_grid, unrounded = fit()
        print(f"{name}: minimax {float(unrounded * 2**24):.3f} * 2^-24, {on_grid:.3f} ulp on the grid")
        for degree, c in enumerate(coefficients):
            show(f"  {name}[{degree}]", c)
        fitted.append(coefficients)
    if "--golden" in sys.argv[1:]:
        print_golden(*fitted)


if __name__ == "__main__":
    with np.errstate(over="ignore", invalid="ignore"):
        main()
