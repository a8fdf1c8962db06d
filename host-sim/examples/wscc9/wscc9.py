"""Writes golden.csv and prints the plant of wscc9.toml: the swing of the WSCC 9-bus system by ANDES.

ANDES (https://github.com/curent/andes, GPL-3.0-or-later) is only called; nothing of it is in this
project, and the example runs without it. To make the files again (Python 3.11), in this folder:

    python3 -m venv venv && venv/bin/pip install andes==2.0.0 kvxopt==1.3.3.3 numpy==2.4.6
    venv/bin/python wscc9.py

Network, loads and power flow are those of ANDES's own case `wscc9/wscc9.xlsx`. It has no machine
data: H and x'd are those of the classical example in P. M. Anderson and A. A. Fouad, "Power System
Control and Stability", chapter 2, on 100 MVA. Loads are constant impedances, which is ANDES's default
in the time domain. The damping is assumed. The case's lines 4-5, 7-8 and 6-9 have reactances of 0.068,
0.0576 and 0.1738, the book's 0.085, 0.072 and 0.17.

The swing equations are those of the network reduced to the internal nodes of the machines,

    delta_i' = w_i,    w_i' = (wb (P_i - Pe_i) - D_i w_i)/M_i,
    Pe_i = sum_j E_i E_j (G_ij cos(delta_i - delta_j) + B_ij sin(delta_i - delta_j)),

with delta in radians, w the deviation of the speed in rad/s, wb = 2 pi 60 rad/s and M = 2 H. ANDES
does not use them: it solves the network's equations in every step.
"""

import csv
import math

import andes
import numpy as np

H = (23.64, 6.4, 3.01)  # s
XD1 = (0.0608, 0.1198, 0.1813)  # pu
DAMPING = (9.456, 2.56, 1.204)  # pu power per pu speed: 0.2/s times M
FREQUENCY = 60.0  # Hz
FAULT_BUS, FAULT, CLEARED = 7, 0.125, 0.25  # s; a short circuit that clears by itself
# Powers of 2, so that times are exact.
START, DURATION, SAMPLE, STEP = 0.5, 5.0, 2.0**-7, 2.0**-11  # s
DIGITS = 10  # of the printed parameters


def load():
    """Return ANDES's case with classical machines and a fault, after the power flow."""
    system = andes.load(
        andes.get_case("wscc9/wscc9.xlsx"), setup=False, no_output=True, default_config=True
    )
    for bus, h, xd1, damping in zip((1, 2, 3), H, XD1, DAMPING):
        voltage = system.Bus.Vn.v[system.Bus.idx.v.index(bus)]
        machine = {"idx": f"G{bus}", "bus": bus, "gen": bus, "Sn": 100.0, "Vn": voltage}
        machine |= {"fn": FREQUENCY, "M": 2.0 * h, "D": damping, "xd1": xd1, "ra": 0.0}
        system.add("GENCLS", machine)
    system.add("Fault", {"bus": FAULT_BUS, "tf": FAULT, "tc": CLEARED, "xf": 1e-3})
    system.setup()
    system.PFlow.config.tol = 1e-12
    assert system.PFlow.run()
    return system


def admittance(system):
    """Return the admittance matrix of the buses with the loads, by the pi model of the lines. [pu]"""
    y = np.zeros((system.Bus.n, system.Bus.n), complex)
    position = {bus: k for k, bus in enumerate(system.Bus.idx.v)}
    line = system.Line
    assert all(line.tap.v == 1.0) and all(line.phi.v == 0.0)
    for k in range(line.n):
        i, j = position[line.bus1.v[k]], position[line.bus2.v[k]]
        series, shunt = 1.0 / (line.r.v[k] + 1j * line.x.v[k]), 0.5j * line.b.v[k]
        y[i, i] += series + shunt
        y[j, j] += series + shunt
        y[i, j] -= series
        y[j, i] -= series
    for bus, p, q in zip(system.PQ.bus.v, system.PQ.p0.v, system.PQ.q0.v):
        y[position[bus], position[bus]] += (p - 1j * q) / system.Bus.v.v[position[bus]] ** 2
    return y


def reduced(system):
    """Return the plant's parameters: those of the network as the machines' internal nodes see it."""
    y = admittance(system)
    voltage = system.Bus.v.v * np.exp(1j * system.Bus.a.v)
    at = [system.Bus.idx.v.index(bus) for bus in (1, 2, 3)]
    current = (y @ voltage)[at]
    internal = voltage[at] + 1j * np.array(XD1) * current
    machine = 1.0 / (1j * np.array(XD1))
    y[at, at] += machine
    link = np.zeros((3, system.Bus.n), complex)
    link[range(3), at] = machine
    y = np.diag(machine) - link @ np.linalg.solve(y, link.T)
    power = (internal * np.conj(y @ internal)).real
    values = {"wb": 2.0 * math.pi * FREQUENCY}
    for i in range(3):
        values |= {f"M{i + 1}": 2.0 * H[i], f"D{i + 1}": DAMPING[i], f"P{i + 1}": power[i]}
        values |= {f"E{i + 1}": abs(internal[i])}
    for i in range(3):
        for j in range(i, 3):
            values |= {f"G{i + 1}{j + 1}": y[i, j].real, f"B{i + 1}{j + 1}": y[i, j].imag}
    del values["B11"], values["B22"], values["B33"]
    return {name: float(f"{value:.{DIGITS}g}") for name, value in values.items()}


def rates(p, x):
    """Return the rates of change of the state by the swing equations."""
    out = [*x[3:]]
    for i in range(3):
        electric = 0.0
        for j in range(3):
            edge = f"{min(i, j) + 1}{max(i, j) + 1}"
            pair, angle = p[f"E{i + 1}"] * p[f"E{j + 1}"], x[i] - x[j]
            electric += pair * p[f"G{edge}"] * math.cos(angle)
            if i != j:
                electric += pair * p[f"B{edge}"] * math.sin(angle)
        net = p["wb"] * (p[f"P{i + 1}"] - electric) - p[f"D{i + 1}"] * x[3 + i]
        out.append(net / p[f"M{i + 1}"])
    return np.array(out)


def deviation(p, rows):
    """Return the largest difference of each component from `rows`, by RK4 with their step."""
    x, worst = np.array(rows[0][1:]), np.zeros(6)
    for row in rows[1:]:
        a = rates(p, x)
        b = rates(p, x + 0.5 * SAMPLE * a)
        c = rates(p, x + 0.5 * SAMPLE * b)
        d = rates(p, x + SAMPLE * c)
        x = x + SAMPLE / 6.0 * (a + 2.0 * (b + c) + d)
        worst = np.maximum(worst, abs(x - row[1:]))
    return worst


def simulate(system, step):
    """Return rows with time from `START`, angles and speed deviations by ANDES, every `SAMPLE`."""
    config = system.TDS.config
    config.tstep, config.fixt, config.shrinkt = step, 1, 0
    config.tol, config.no_tqdm, config.honest = 1e-10, 1, 1
    # ANDES moves its steps at a fault; it goes on from the end of a run in whole ones.
    for config.tf in (START, START + DURATION):
        assert system.TDS.run()
    times = np.array(system.dae.ts.t)
    angles = system.dae.ts.x[:, system.GENCLS.delta.a]
    speeds = 2.0 * math.pi * FREQUENCY * (system.dae.ts.x[:, system.GENCLS.omega.a] - 1.0)
    rows = []
    for k in range(round(DURATION / SAMPLE) + 1):
        (at,) = np.flatnonzero(times == START + k * SAMPLE)
        rows.append([k * SAMPLE, *map(float, angles[at]), *map(float, speeds[at])])
    return rows


def plant(p, state):
    """Return `[plant]` of the scenario, with angles relative to that of machine 1."""
    angles = {(2, 1): "a2", (3, 1): "a3", (2, 3): "a2 - a3"}  # of the first machine to the second
    derivative = ["w2 - w1", "w3 - w1"]
    for i in (1, 2, 3):
        power = f"P{i} - E{i}^2*G{i}{i}"
        for pair, angle in angles.items():
            if i in pair:
                j, k = sorted(pair)
                sign = "+" if i == pair[0] else "-"
                power += f" - E{j}*E{k}*(G{j}{k}*cos({angle}) {sign} B{j}{k}*sin({angle}))"
        derivative.append(f"(wb*({power}) - D{i}*w{i})/M{i}")
    initial = [state[1] - state[0], state[2] - state[0], *state[3:]]
    lines = ["[plant]", 'model = "expressions"', 'states = ["a2", "a3", "w1", "w2", "w3"]']
    lines += ["derivative = [", *(f'    "{text}",' for text in derivative), "]"]
    lines += [f"initial_state = {initial}", "[plant.parameters]"]
    return "\n".join(lines + [f"{name} = {value!r}" for name, value in p.items()])


def main():
    """Write golden.csv; print the plant, and how far its equations are from ANDES."""
    system = load()
    parameters = reduced(system)
    rows = simulate(system, STEP)
    with open("golden.csv", "w", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(["t", "delta1", "delta2", "delta3", "w1", "w2", "w3"])
        out.writerows(rows)
    print(plant(parameters, rows[0][1:]))
    print("largest differences [rad, rad/s]:", deviation(parameters, rows))
    coarse = deviation(parameters, simulate(load(), 2.0 * STEP))
    print("largest differences with twice ANDES's step:", coarse)
    for name, value in parameters.items():
        third = 10.0 ** (math.floor(math.log10(abs(value))) - 2)
        changed = deviation(parameters | {name: value + third}, rows)
        print(f"with {name} + {third:g}: {changed}")


if __name__ == "__main__":
    main()
