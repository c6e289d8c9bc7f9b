"""Time the fit of a measured folder beside pyAT's calculation of the response of the same ring, on one core, in one run.

    python measured_fit.py ORBITCAL FOLDER

pyAT (PyPI: accelerator-toolbox): the closed orbits at plus and minus half of every kick, by tracking at a held momentum; a LOCO fit by differences needs
this once for every magnet and step. Two lines of output.
"""

import contextlib
import csv
import io
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

with contextlib.redirect_stdout(io.StringIO()):  # a word on plotting, which is not used
    import at


def rows(file):
    return list(csv.DictReader(open(file, newline="")))


def element(row):
    """pyAT's element of a row of lattice.csv; sextupoles do nothing to first order on the reference orbit."""
    name, length, bend, k1 = row["name"], *(float(row[key]) for key in ("length_m", "bend_rad", "k1_start_1_m2"))
    if bend:
        edges = [float(row[key]) for key in ("edge_in_rad", "edge_out_rad")]
        return at.Dipole(name, length, bend, k1, EntranceAngle=edges[0], ExitAngle=edges[1])
    if k1:
        return at.Quadrupole(name, length, k1)
    return at.Drift(name, length) if length else at.Marker(name)


def response(ring, monitors, correctors):
    """Orbit at plus less that at minus half the kick [mm], x of all monitors, then y; one column a corrector."""
    columns = []
    for at_, plane, kick in correctors:
        orbits = []
        for sign in (1, -1):
            ring[at_].KickAngle = np.array([sign * kick / 2e3 if plane == p else 0.0 for p in "xy"])
            orbits.append(at.find_orbit4(ring, 0.0, refpts=monitors)[1][:, [0, 2]].T.ravel())
        ring[at_].KickAngle = np.zeros(2)
        columns.append(1e3 * (orbits[0] - orbits[1]))
    return np.array(columns).T


def main():
    orbitcal, folder = sys.argv[1], Path(sys.argv[2])
    lattice, bpms, steerers = (rows(folder / f"{name}.csv") for name in ("lattice", "bpms", "correctors"))
    energy = json.loads((folder / "meta.json").read_text())["energy_GeV"] or 5.0
    placed = {int(row["lattice_index"]) for row in steerers}
    elements = [element(row) for row in lattice]
    for index in placed:
        elements[index] = at.Corrector(lattice[index]["name"], float(lattice[index]["length_m"]), [0.0, 0.0])
    ring = at.Lattice(elements, energy=energy * 1e9, periodicity=1)
    ring.disable_6d()
    monitors = sorted({int(row["lattice_index"]) for row in bpms})
    correctors = [(int(row["lattice_index"]), row["plane"], float(row["nominal_kick_mrad"])) for row in steerers]
    start = time.perf_counter()
    answer = response(ring, monitors, correctors)
    seconds = time.perf_counter() - start
    print(f"pyAT {at.__version__}: {answer.shape[0]} x {answer.shape[1]} responses in {seconds:.2f} s, rms {answer.std():.4f} mm")
    start = time.perf_counter()
    told = subprocess.run([orbitcal, "fit", folder], capture_output=True, text=True, check=True).stdout
    print(f"orbitcal: the whole fit in {time.perf_counter() - start:.2f} s; {told.splitlines()[0]}")


if __name__ == "__main__":
    main()
