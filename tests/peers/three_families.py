"""A small ring with three quadrupole families, simulated by pyAT: a machine file and one orbit-response campaign (format 2).

Eight cells of 7 m, 160 MeV protons, tunes 1.72 and 1.81. A cell holds, in beam order, a monitor and a corrector that both act
in both planes, QF, a dipole of 45 degrees, QD and QT; each family has a supply of its own. 24 quadrupole factors are unknown.

    python3 -m venv venv && venv/bin/pip install accelerator-toolbox==0.9.0
    venv/bin/python three_families.py OUT     # OUT/ring.json, OUT/campaign/{header.toml,frames.csv,truth.json}

Every cycle is the closed orbit of the misaligned ring at that cycle's read-backs: pyAT's exact Hamiltonian, nothing linearised.
"""

import csv
import json
import sys
from pathlib import Path

import at
import numpy as np

CELLS, CELL_M = 8, 7.0
K1 = {"QF": 0.522877329, "QD": -1.274281241, "QT": 0.5}  # [1/m2], matched to the tunes above
NOMINAL_A = {"dipole": 600.0, "QF": 240.0, "QD": 410.0, "QT": 80.0}
TRANSFER = {"QF": [0.0, 1.0], "QD": [0.003, 1.012, -0.015], "QT": [0.0, 1.0]}  # p(I/I_nominal) of each supply
MRAD_PER_A = 0.05
SETTING_A, REPEATS = 16.0, 4  # every corrector at 0, + and -: 0.8 mrad, some millimetres
READING_MM, OFFSET_MM, QUAD_M = 0.02, 0.7, 2e-4  # sigma of readings, of monitor offsets, of quadrupole misalignments
RIPPLE, CORRECTOR_A, TUNE = 2e-4, 2e-3, 2e-4  # sigma of supplies (relative), of corrector currents, of the tune meter
VAR = 0.02  # sigma of ln factor


def elements():
    """Machine-file elements of the ring, in beam order."""
    for cell in range(1, CELLS + 1):
        start = (cell - 1) * CELL_M
        for offset, name, kind, length, more in (
            (0.3, f"BPM_{cell}", "bpm", 0.0, {"plane": "HV"}),
            (0.5, f"COR_{cell}", "corrector", 0.0, {"plane": "HV"}),
            (0.7, f"QF_{cell}F", "quadrupole", 0.3, {"family": "QF"}),
            (1.4, f"B_{cell}", "sbend", 2.4, {"angle": 2 * np.pi / CELLS}),
            (4.2, f"QD_{cell}D", "quadrupole", 0.3, {"family": "QD"}),
            (5.5, f"QT_{cell}T", "quadrupole", 0.2, {"family": "QT"}),
        ):
            yield {"name": name, "type": kind, "s_start": round(start + offset, 6), "length": length, **more}


MACHINE = {
    "name": "three families",
    "circumference_m": CELLS * CELL_M,
    "k1": K1,
    "families": {family: {"supply": family} for family in K1},
    "reference": {"particle": "proton", "kinetic_energy_GeV": 0.16},
    "elements": list(elements()),
}


def lattice():
    """The pyAT ring and its elements by name; gaps become drifts."""
    ring, named, s = [], {}, 0.0
    for e in MACHINE["elements"]:
        ring.append(at.Drift("gap", e["s_start"] - s, PassMethod="ExactDriftPass"))
        name, length = e["name"], e["length"]
        if e["type"] == "quadrupole":
            element = at.Quadrupole(name, length, K1[e["family"]], PassMethod="ExactMultipolePass", NumIntSteps=12)
        elif e["type"] == "sbend":
            element = at.Dipole(name, length, e["angle"], PassMethod="ExactSectorBendPass", NumIntSteps=12)
        elif e["type"] == "corrector":
            element = at.Corrector(name, 0.0, [0.0, 0.0])
        else:
            element = at.Monitor(name)
        ring.append(element)
        named[name] = element
        s = e["s_start"] + length
    ring.append(at.Drift("gap", CELLS * CELL_M - s, PassMethod="ExactDriftPass"))
    ring = at.Lattice(ring, energy=1e9, periodicity=1)  # the energy does not enter: all strengths are over the rigidity
    ring.disable_6d()
    return ring, named


def strength(family, current):
    """K1 [1/m2] of a family's magnets at the read-backs of one cycle, by the formula of docs/recording.md."""
    p = np.polynomial.Polynomial(TRANSFER[family])
    rigidity = current["dipole"] / NOMINAL_A["dipole"]
    return K1[family] * p(current[family] / NOMINAL_A[family]) / p(1.0) / rigidity


def settings():
    """The cycles: (corrector, plane, current), first a baseline with none."""
    yield from [(None, None, 0.0)] * REPEATS
    for plane in "HV":
        for cell in range(1, CELLS + 1):
            for current in (0.0, SETTING_A, -SETTING_A):
                yield from [(cell, plane, current)] * REPEATS


def campaign(seed):
    """Rows of frames.csv and the true factor of every quadrupole."""
    random = np.random.default_rng(seed)
    ring, named = lattice()
    quads = [e for e in MACHINE["elements"] if e["type"] == "quadrupole"]
    factor = {e["name"]: float(np.exp(VAR * random.standard_normal())) for e in quads}
    for e in quads:
        at.shift_elem(named[e["name"]], *(QUAD_M * random.standard_normal(2)))
    monitors = [i for i, e in enumerate(ring) if isinstance(e, at.Monitor)]
    offset = OFFSET_MM * random.standard_normal((CELLS, 2))
    rows = []
    for cycle, (cell, plane, setting) in enumerate(settings()):
        current = {s: round(a * (1 + RIPPLE * random.standard_normal()), 4) for s, a in NOMINAL_A.items()}
        for e in quads:
            named[e["name"]].PolynomB[1] = factor[e["name"]] * strength(e["family"], current)
        steering = CORRECTOR_A * random.standard_normal((CELLS, 2))
        if cell:
            steering[cell - 1, "HV".index(plane)] += setting
        steering = steering.round(4)
        for i in range(CELLS):
            named[f"COR_{i + 1}"].KickAngle[:] = 1e-3 * MRAD_PER_A * steering[i]
        start, orbit = at.find_orbit4(ring, dp=0.0, refpts=monitors, convergence=1e-13)
        reading = 1e3 * orbit[:, [0, 2]] + offset + READING_MM * random.standard_normal((CELLS, 2))
        one_turn, _ = at.find_m44(ring, dp=0.0, orbit=start)
        tune = [tune_of(one_turn[i : i + 2, i : i + 2]) + TUNE * random.standard_normal() for i in (0, 2)]
        rows.append(
            {"seq": cycle, "time_s": f"{2.0 * cycle:.1f}"}
            | {"corrector": f"{plane}_{cell}" if cell else "", "setting_A": f"{setting:g}"}
            | {f"i_{s}_A": f"{a:.4f}" for s, a in current.items()}
            | {f"ic_{p}_{i + 1}_A": f"{steering[i, k]:.4f}" for k, p in enumerate("HV") for i in range(CELLS)}
            | {f"{xy}_{i + 1}_mm": f"{reading[i, k]:.4f}" for k, xy in enumerate("xy") for i in range(CELLS)}
            | {f"q{xy}_frac": f"{q:.5f}" for xy, q in zip("xy", tune)}
        )
    return rows, {name.split("_")[1]: value for name, value in factor.items()}


def tune_of(m):
    """Fractional tune of one plane's 2x2 turn: cos 2 pi Q is half its trace, the sign of M12 says which half."""
    q = np.arccos(np.trace(m) / 2) / (2 * np.pi)
    return q if m[0, 1] > 0 else 1 - q


def table(values):
    """A TOML inline table."""
    return "{ " + ", ".join(f"{key} = {value}" for key, value in values.items()) + " }"


def header():
    """header.toml: what holds for the whole campaign."""
    return f"""format = 2
machine = "{MACHINE['name']}"
lattice = "ring.json"
recorded_with = "pyAT {at.__version__}, exact maps"
particle = "proton"
kinetic_energy_GeV = 0.16
bpm_sigma_mm = {READING_MM}
kick_mrad_per_A = {MRAD_PER_A}
kick_convention = "one setting per frame; 0 A frames are the baseline"
believed_rf = "fixed_momentum"
nominal_A = {table(NOMINAL_A)}
quad_transfer = {table(TRANSFER)}
"""


def main(out):
    folder = Path(out) / "campaign"
    folder.mkdir(parents=True, exist_ok=True)
    rows, factor = campaign(seed=83)
    (folder.parent / "ring.json").write_text(json.dumps(MACHINE, indent=1) + "\n")
    (folder / "header.toml").write_text(header())
    (folder / "truth.json").write_text(json.dumps({"vars": factor, "effects": []}, indent=1) + "\n")
    with open(folder / "frames.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else ".")
