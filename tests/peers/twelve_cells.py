"""A small electron ring whose response matrix pyAT measures, in the tables of docs/real-rings.md, before and after two magnets change.

Twelve cells of a monitor, QF, a corrector, a dipole, QD; skew quadrupoles in every third cell; 1.5 GeV, tunes near 4.25 and 3.26, RF frequency
held. The machine differs from its lattice.csv by factors of 1 % in the quadrupoles, skew gradients, gains and couplings of all
instruments; two monitors are exchanged. AFTER is the same machine with QF of cell 4 stronger by 1 % and QD of cell 9 weaker by 0.7 %.

    python3 -m venv venv && venv/bin/pip install accelerator-toolbox==0.9.0
    venv/bin/python twelve_cells.py OUT     # OUT/{before,after}/{lattice,bpms,correctors,orm_measured_mm,dispersion_orbit_mm}.csv, meta.json

Every column is the difference of two closed orbits of pyAT at half the kick of either sign, at the path length that the RF frequency holds.
"""

import csv
import json
import sys
from pathlib import Path

import at
import numpy as np

CELLS, K1 = 12, {"QF": 4.0, "QD": -3.0}  # [1/m2]
NOISE_MM, KICK_MRAD, DELTA_RF = 0.002, {"x": 0.2, "y": 0.15}, 2000.0
FACTOR, SKEW, GAIN, COUPLING = 0.01, 0.002, 0.03, 0.01  # sigma; the skew gradient integrated [1/m]
EXCHANGED = (3, 7)  # rows of two horizontal monitors
CHANGES = {("QF", 3): 0.010, ("QD", 8): -0.007}


def rows():
    """Elements as the lattice file has them: name, length [m], bend [rad], k1 [1/m2], cell."""
    for cell in range(CELLS):
        yield "BPM", 0.0, 0.0, 0.0, cell
        yield "L", 0.4, 0.0, 0.0, cell
        yield "QF", 0.3, 0.0, K1["QF"], cell
        yield "COR", 0.2, 0.0, 0.0, cell
        yield "B", 1.2, 2 * np.pi / CELLS, 0.0, cell
        if cell % 3 == 0:
            yield "SD", 0.2, 0.0, 0.0, cell
        yield "QD", 0.3, 0.0, K1["QD"], cell
        yield "L", 0.6 if cell % 3 == 0 else 0.8, 0.0, 0.0, cell


def element(name, length, bend, k1):
    """pyAT's element of a row."""
    if bend:
        return at.Dipole(name, length, bend, EntranceAngle=bend / 2, ExitAngle=bend / 2)
    if name in ("QF", "QD"):
        return at.Quadrupole(name, length, k1)
    if name == "SD":
        return at.Multipole(name, length, [0.0, 0.0], [0.0, 0.0])
    if name == "COR":
        return at.Corrector(name, length, [0.0, 0.0])
    return at.Monitor(name) if name == "BPM" else at.Drift(name, length)


def orbit(ring, monitors, df=0.0):
    """Closed orbit [m] at the monitors, x and y: [2, cells]."""
    _, found = at.find_orbit4(ring, df=df, refpts=monitors)
    return found[:, [0, 2]].T


def measure(ring, lattice, truth, random):
    """Matrix [mm] and dispersion orbit [mm] as the instruments of the machine see them."""
    monitors = [i for i, row in enumerate(lattice) if row[0] == "BPM"]
    correctors = [i for i, row in enumerate(lattice) if row[0] == "COR"]

    def seen(both):  # [2, cells] as readings: x of all monitors, then y
        read = [truth["monitor_gain"][p] * both[p] + truth["monitor_coupling"][p] * both[1 - p] for p in (0, 1)]
        return 1e3 * np.concatenate(read)

    columns = []
    for p, plane in enumerate("xy"):
        for number, index in enumerate(correctors):
            kick = np.zeros(2)
            kick[p] = truth["corrector_gain"][p][number]
            kick[1 - p] = truth["corrector_coupling"][p][number]
            kick *= 1e-3 * KICK_MRAD[plane] / 2
            orbits = []
            for sign in (1, -1):
                ring[index].KickAngle = sign * kick
                orbits.append(seen(orbit(ring, monitors)))
            ring[index].KickAngle = np.zeros(2)
            columns.append(orbits[0] - orbits[1])
    matrix = np.array(columns).T
    dispersion = seen(orbit(ring, monitors, DELTA_RF)) - seen(orbit(ring, monitors))
    return [one + NOISE_MM * random.standard_normal(one.shape) for one in (matrix, dispersion)]


def write(folder, lattice, matrix, dispersion, circumference, rf):
    """The tables of a measurement."""
    folder.mkdir(parents=True, exist_ok=True)

    def table(name, head, lines):
        with open(folder / name, "w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([head, *lines])

    starts = np.concatenate([[0.0], np.cumsum([row[1] for row in lattice])])[:-1]
    head = ["index", "name", "s_entrance_m", "length_m", "bend_rad", "edge_in_rad", "edge_out_rad", "k1_start_1_m2", "k2_half_1_m3"]
    table("lattice.csv", head, [[i, name, f"{s:.4f}", length, bend, bend / 2, bend / 2, k1, 0] for i, (s, (name, length, bend, k1, _)) in enumerate(zip(starts, lattice))])
    at_ = {name: [i for i, row in enumerate(lattice) if row[0] == name] for name in ("BPM", "COR", "SD", "QF", "QD")}
    both = [(plane, i) for plane in "xy" for i in range(CELLS)]
    table("bpms.csv", ["row", "plane", "lattice_index", "sigma_mm", "used_by_reference_fit"], [[row, plane, at_["BPM"][i], NOISE_MM, 1] for row, (plane, i) in enumerate(both)])
    table("correctors.csv", ["col", "plane", "lattice_index", "nominal_kick_mrad", "used_by_reference_fit"], [[col, plane, at_["COR"][i], KICK_MRAD[plane], 1] for col, (plane, i) in enumerate(both)])
    names = [f"{plane}{at_['BPM'][i]}" for plane, i in both]
    table("orm_measured_mm.csv", ["", *(f"{plane}{at_['COR'][i]}" for plane, i in both)], [[name, *(f"{value:.6f}" for value in line)] for name, line in zip(names, matrix)])
    table("dispersion_orbit_mm.csv", ["", "eta_for_deltaRF"], [[name, f"{value:.6f}"] for name, value in zip(names, dispersion)])
    free = [{"elements": [i], "field": "K"} for name in ("QF", "QD") for i in at_[name]]
    free += [{"elements": [i], "field": "PolynomA"} for i in at_["SD"]]
    meta = {"circumference_m": circumference, "energy_GeV": 1.5, "rf_Hz": rf, "delta_rf_Hz": DELTA_RF, "reference_fit": {"fit_parameters": free, "flags": {"Coupling": "Yes", "Dispersion": "Yes"}}}
    (folder / "meta.json").write_text(json.dumps(meta, indent=1) + "\n")


def main(out):
    random = np.random.default_rng(12)
    lattice = list(rows())
    normal = random.standard_normal
    factors = {(row[0], row[4]): 1 + FACTOR * normal() for row in lattice if row[0] in K1}
    skews = {row[4]: SKEW * normal() for row in lattice if row[0] == "SD"}
    truth = {
        "monitor_gain": 1 + GAIN * normal((2, CELLS)),
        "monitor_coupling": COUPLING * normal((2, CELLS)),
        "corrector_gain": 1 + GAIN * normal((2, CELLS)),
        "corrector_coupling": COUPLING * normal((2, CELLS)),
    }
    elements = [element(*row[:4]) for row in lattice]
    ring = at.Lattice(elements, energy=1.5e9, periodicity=1)
    harmonic = round(ring.circumference * 5e8 / at.constants.clight)
    ring.append(at.RFCavity("CAV", 0.0, 1e6, harmonic * at.constants.clight / ring.circumference, harmonic, 1.5e9))
    ring.disable_6d()
    rf = ring.get_rf_frequency()
    key = {"exchanged_rows": EXCHANGED, "changes": [{"name": name, "cell": cell + 1, "relative": change} for (name, cell), change in CHANGES.items()]}
    for state, changes in (("before", {}), ("after", CHANGES)):
        vars_ = {}
        for i, (name, _, _, k1, cell) in enumerate(lattice):
            if name in K1:
                factor = factors[name, cell] * (1 + changes.get((name, cell), 0.0))
                ring[i].PolynomB[1] = k1 * factor
                vars_[f"{name}.{i}"] = factor
            if name == "SD":
                ring[i].PolynomA[1] = skews[cell] / ring[i].Length
        matrix, dispersion = measure(ring, lattice, truth, random)
        i, j = EXCHANGED
        matrix[[i, j]], dispersion[[i, j]] = matrix[[j, i]], dispersion[[j, i]]
        write(out / state, lattice, matrix, dispersion, ring.circumference, rf)
        key[state] = vars_
        print(state, "tunes", ring.get_tune())
    (out / "truth.json").write_text(json.dumps(key, indent=1) + "\n")


main(Path(sys.argv[1]))
