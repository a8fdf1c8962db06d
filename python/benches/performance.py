"""Measure the module alongside the command line, in turns: `python python/benches/performance.py PATH-OF-HOST-SIM`.

Prints the fastest and the median of a step of one agent, and of the paper's run.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import time
import timeit
from collections.abc import Callable

import numpy as np

import distributed_observer as do

RUNS = 20


def step(measurement: object) -> str:
    agent = do.Agent(do.load("paper").package(1), health=False)
    samples = timeit.repeat(lambda: agent.step(measurement), number=20_000, repeat=RUNS)
    return line([sample / 20_000 * 1e6 for sample in samples], "µs")


def exchange() -> str:
    """A step, with a frame received before it and the estimate read after it."""
    paper = do.load("paper")
    agent, other = (do.Agent(paper.package(number), health=False) for number in (2, 1))
    frames = []
    while len(frames) < 30_000:
        if frame := other.step(np.float32([np.sin(0.01 * other.tick)])):
            frames.append(frame)
    measurement = np.zeros(1, np.float32)
    samples = []
    for first in range(0, 30_000, 1_500):
        start = time.perf_counter()
        for frame in frames[first : first + 1_500]:
            agent.receive(frame)
            agent.step(measurement)
            agent.estimate
        samples.append((time.perf_counter() - start) / 1_500 * 1e6)
    return line(samples, "µs")


def line(samples: list[float], unit: str) -> str:
    return f"{min(samples):.3f} {unit} fastest, {statistics.median(samples):.3f} {unit} median"


def timed(function: Callable[[], object]) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def main() -> None:
    print("step, f32 array:    ", step(np.array([0.5], dtype=np.float32)))
    print("step, f64 array:    ", step(np.array([0.5])))
    print("step, float:        ", step(0.5))
    print("step, list:         ", step([0.5]))
    print("receive, step, read:", exchange())
    if len(sys.argv) < 2:
        return
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.argv[1], "run", "paper", "--out", f"{folder}/out", "--format=json"]
        lines, calls = [], []
        for _ in range(RUNS + 1):
            lines.append(timed(lambda: subprocess.run(command, capture_output=True, check=True)))
            calls.append(timed(lambda: do.load("paper").run()))
    # The first of each warms the caches.
    print("paper, command line:", line(lines[1:], "s"))
    print("paper, Python:      ", line(calls[1:], "s"))
    ratio = statistics.median(calls[1:]) / statistics.median(lines[1:])
    print(f"Python relative to the command line: {100 * (ratio - 1):+.1f} % (medians)")


if __name__ == "__main__":
    main()
