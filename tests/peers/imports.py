"""Import rings that the codes themselves have written, and compare tunes and the response matrix with each code's own.

The response of each code (kicks of +-2 urad, momentum held) is written as a plain table in the code's own names, imported with its
lattice by `orbitcal import`, whose JSON has the largest difference from the matrix of the twin. That of a MAT-file of level 7.3 stands in HDF5.

Usage: imports.py ORBITCAL; one line a ring and code, exit status 1 beyond the tolerances.
"""

import csv
import json
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import h5py
import import_lattices as lattices
import numpy as np
import pals
from import_lattices import at, xtrack

warnings.filterwarnings("ignore")
KICK = 2e-6  # rad
at.DConstant.XYStep = 1e-6  # m: the 3e-8 that pyAT takes of itself leaves up to 4e-7 of rounding in a tune
TUNE, RESPONSE = 1e-6, 1e-4  # tolerances [1, m/rad], those of exports.py: tracking steps of the codes and rounding of orbits


def numbers(elements, kind):
    return [number for number, one in enumerate(elements) if one[1] == kind]


def columns(orbit, correctors):
    """Response [m/rad], x of all monitors then y, by correctors in x then y; `orbit(corrector, plane, kick)` gives x and y."""
    both = [(np.concatenate(orbit(one, plane, KICK)) - np.concatenate(orbit(one, plane, -KICK))) / (2 * KICK)
            for plane in (0, 1) for one in correctors]
    return np.array(both).T


def of_at(elements):
    ring = lattices.pyat(elements)
    ring.disable_6d()
    monitors = numbers(elements, "monitor")

    def orbit(corrector, plane, kick):
        ring[corrector].KickAngle = [kick * (plane == 0), kick * (plane == 1)]
        _, found = at.find_orbit4(ring, 0.0, monitors, convergence=1e-12, max_iterations=50)
        ring[corrector].KickAngle = [0.0, 0.0]
        return found[:, 0], found[:, 2]

    names = lambda word, count: [f"{word}[{n + 1}]" for n in range(count)]
    return at.get_tune(ring, get_integer=True)[:2], columns(orbit, numbers(elements, "kicker")), names("BPM", len(monitors)), names("COR", lattices.CELLS)


def own_names(elements, separator="."):
    return [[f"{elements[n][0]}{separator}{n}" for n in numbers(elements, kind)] for kind in ("monitor", "kicker")]


def of_madx(elements):
    code = lattices.madx(elements)
    code.input("cav, volt=0;")
    monitors, correctors = own_names(elements)
    table = code.twiss(tolerance=1e-14)
    rows = {row.split(":")[0]: n for n, row in enumerate(table.name)}
    tunes, places = [table.summary.q1, table.summary.q2], [rows[name] for name in monitors]

    def orbit(corrector, plane, kick):
        knob = "hkick" if plane == 0 else "vkick"
        code.input(f"{elements[corrector][0]}.{corrector}, {knob}={kick};")
        found = code.twiss(tolerance=1e-14)
        code.input(f"{elements[corrector][0]}.{corrector}, {knob}=0;")
        return np.array(found.x)[places], np.array(found.y)[places]

    matrix = columns(orbit, numbers(elements, "kicker"))
    code.exit()
    return tunes, matrix, monitors, correctors


def of_xsuite(elements):
    line = lattices.xsuite(elements)
    line.build_tracker()
    monitors, correctors = own_names(elements)
    twiss = line.twiss4d(co_search_settings={"xtol": 1e-14})
    places = [line.element_names.index(name) for name in monitors]

    def orbit(corrector, plane, kick):
        element = line[f"{elements[corrector][0]}.{corrector}"]
        field, sign = (element.knl, -1.0) if plane == 0 else (element.ksl, 1.0)
        field[0] = sign * kick
        start = line.find_closed_orbit(delta0=0, co_search_settings={"xtol": 1e-14})
        line.track(start, turn_by_turn_monitor="ONE_TURN_EBE")
        field[0] = 0.0
        return line.record_last_track.x[0, places], line.record_last_track.y[0, places]

    return [twiss.qx, twiss.qy], columns(orbit, numbers(elements, "kicker")), monitors, correctors


def of_pals(elements):
    """The numbers are pyAT's of the same ring; `pals-schema` validates the file."""
    tunes, matrix, _, _ = of_at(elements)
    return tunes, matrix, *own_names(elements, "_")


CODES = {"at": of_at, "mat": of_at, "octave": of_at, "v73": of_at, "madx": of_madx, "xsuite": of_xsuite, "pals": of_pals}


def table(path, matrix, monitors, correctors):
    both = lambda names: [f"{plane}:{name}" for plane in "xy" for name in names]
    with open(path, "w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(
            [["", *both(correctors)], *([name, *map(repr, map(float, row))] for name, row in zip(both(monitors), matrix))])


def hdf5(path, matrix):
    """The dataset, and that its lines and columns are all of x, then all of y."""
    with h5py.File(path, "w") as file:
        file.create_dataset("measured/response_matrix", data=matrix, compression="gzip")
    return [f"{path}:/measured/response_matrix", "--order", "planes"]


def imported(orbitcal, folder, path, matrix, code):
    """The result of `orbitcal import` of a matrix in m/rad."""
    patterns = ["--monitors", "bpm*", "--correctors", "cor*"] if code == "xsuite" else []
    rf = ["--rf-frequency", "499654096.7"] if code == "pals" else []
    out = folder / f"{path.name}-folder"
    done = subprocess.run([orbitcal, "import", path, "--matrix", *matrix, "--out", out, "--orbit-unit", "m", "--kick", "1000", "--kick-is", "full",
                           "--kick-sign", "x+y+", "--noise", "1e-3", "--rf", "fixed-momentum", "--quiet", "--json", "-", *patterns, *rf], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def main(orbitcal):
    good = True
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for ring, elements in lattices.RINGS.items():
            for code, own in CODES.items():
                if code not in lattices.WRITERS:
                    print(f"{ring:14} {code:7} not installed")
                    continue
                path = lattices.write(ring, code, folder)
                if code == "pals":
                    pals.load(str(path))
                tunes, matrix, monitors, correctors = own(list(elements()))
                table(folder / "matrix.csv", matrix, monitors, correctors)
                file = hdf5(folder / "matrix.h5", matrix) if code == "v73" else [folder / "matrix.csv"]
                found = imported(orbitcal, folder, path, file, code)
                tune = max(abs(a - b) for a, b in zip(tunes, found["tunes"]))
                error = max(one["largest_difference_mm"] for one in found["agreement"]) / 1e3  # of a kick of 1 rad
                agrees = tune < TUNE and error < RESPONSE
                good &= agrees
                print(f"{ring:14} {code:7} tunes {tune:8.1e}  response {error:8.1e} m/rad{'' if agrees else '  BEYOND THE TOLERANCE'}", flush=True)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]).resolve()))
