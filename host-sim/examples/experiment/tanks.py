"""Writes tanks.csv: three coupled water tanks, as if they had been measured.

A pump feeds the first tank, which flows into the second, and that into the third. Levels are in
decimetres, times in seconds. Each level is measured with noise of 0.5 mm and a resolution of 0.5 mm, at
20 Hz. The script needs nothing but Python; the file is committed, so that the example runs without it.
"""

import csv
import math
import random

DURATION, STEP, SAMPLE = 120.0, 0.001, 50  # s, s, steps
OUTFLOW = (0.42, 0.38, 0.35)  # dm^1.5/s per dm^2 of area
NOISE = RESOLUTION = 0.005  # dm


def pump(t):
    """Return the inflow over the area of the first tank. [dm/s]"""
    return 0.55 + 0.22 * math.sin(0.35 * t) + (0.12 if math.sin(0.11 * t) > 0 else -0.12)


def rates(t, h):
    """Return the rates of change of the levels. [dm/s]"""
    out = [a * math.sqrt(max(level, 0.0)) for a, level in zip(OUTFLOW, h)]
    return [pump(t) - out[0], out[0] - out[1], out[1] - out[2]]


def main():
    """Simulate by Heun's method and write every 50th step."""
    noise = random.Random(7)
    h = [1.0, 1.5, 2.0]
    with open("tanks.csv", "w", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(["t", "pump", "y1", "y2", "y3", "h1", "h2", "h3"])
        for k in range(round(DURATION / STEP) + 1):
            t = k * STEP
            if k % SAMPLE == 0:
                measured = (x + noise.gauss(0.0, NOISE) for x in h)
                rounded = [RESOLUTION * round(y / RESOLUTION) for y in measured]
                out.writerow(
                    [f"{t:.2f}", f"{pump(t):.4f}"]
                    + [f"{y:.3f}" for y in rounded]
                    + [f"{x:.5f}" for x in h]
                )
            first = rates(t, h)
            ahead = [x + STEP * rate for x, rate in zip(h, first)]
            second = rates(t + STEP, ahead)
            h = [x + 0.5 * STEP * (a + b) for x, a, b in zip(h, first, second)]


if __name__ == "__main__":
    main()
