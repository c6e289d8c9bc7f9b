"""A LOCO file of a measured ring, in the structs of the Matlab Middle Layer, from the tables of docs/real-rings.md; imported again and compared.

The structs are those that `buildlocoinput.m`, `locofilecheck.m` and `mkparamgroup.m` (Matlab Middle Layer, Accelerator Toolbox) write and read, by
scipy; Octave, where it is installed, loads and saves them as Matlab does, with `inline` objects as functions.

    python3 loco.py FOLDER OUT.mat         # the LOCO file of a folder
    python3 loco.py --check ORBITCAL FOLDER...   # import it, compare every field with the folder, and the fits with each other
"""

import csv
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy.io import savemat

ROUNDING = {"lattice.csv": 1e-11, "bpms.csv": 0.0, "correctors.csv": 0.0, "meta.json": 1e-9}  # lengths and strengths of a table have twelve digits or ten, the circumference is their sum
POSITION = 5e-5  # m: entrances in a table have four decimals at least; here they are sums of lengths
FIT = 1e-4  # relative: the iterations of a fit stop elsewhere when positions are rounded; 4e-5 found
OCTAVE = """
load('{file}');
for i = 1:numel(FitParameters)
  for j = 1:numel(FitParameters(i).Params)
    for k = 1:numel(FitParameters(i).Params{{j}})
      FitParameters(i).Params{{j}}(k).Function = inline(FitParameters(i).Params{{j}}(k).Function);
    end
  end
end
save('-v7', '{file}', 'BPMData', 'CMData', 'FitParameters', 'LocoFlags', 'LocoMeasData', 'LocoModel', 'RINGData');
"""


def read(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def numbers(path):
    with open(path, newline="") as file:
        return np.array([[float(cell or "nan") for cell in row[1:]] for row in list(csv.reader(file))[1:]])


def cells(items):
    """A cell array, one line."""
    array = np.empty((1, len(items)), dtype=object)
    array[0, :] = items
    return array


def structs(items):
    """A struct array, one line."""
    array = np.empty((1, len(items)), dtype=[(name, object) for name in items[0]])
    for place, item in enumerate(items):
        array[0, place] = tuple(item.values())
    return array


def element(row, instruments):
    """AT's element of a row of the lattice, as Matlab has it: no class but a pass method."""
    number = {name: float(row.get(name) or 0) for name in ("length_m", "bend_rad", "edge_in_rad", "edge_out_rad", "k1_start_1_m2", "k2_half_1_m3", "ks1_1_m2")}
    one = {"FamName": row["name"], "Length": number["length_m"]}
    k1, k2, skew = number["k1_start_1_m2"], number["k2_half_1_m3"], number["ks1_1_m2"]
    magnet = number["bend_rad"] or k1 or k2 or row["name"] in instruments["magnets"]
    usual = "CorrectorPass" if row["name"] in instruments["correctors"] else "DriftPass" if number["length_m"] else "IdentityPass"
    one["PassMethod"] = row.get("pass_method") or ("BendLinearPass" if number["bend_rad"] else "QuadLinearPass" if k1 and row["name"] in instruments["k"] else "StrMPoleSymplectic4Pass" if magnet else usual)
    if number["bend_rad"]:
        one |= {"BendingAngle": number["bend_rad"], "EntranceAngle": number["edge_in_rad"], "ExitAngle": number["edge_out_rad"]}
    if magnet:
        one |= {"K": k1} if row["name"] in instruments["k"] else {}
        one |= {"PolynomA": np.array([0.0, skew, 0.0]), "PolynomB": np.array([0.0, k1, k2]), "MaxOrder": 2.0}
    if one["PassMethod"] == "CorrectorPass":
        one["KickAngle"] = np.array([0.0, 0.0])
    return one


def has_k(group):
    return group["field"] == "K" and group["elements"][::2] == group["elements"][1::2]


def parameter(group):
    """A group of magnets: of one with K the gradient is K and the second of PolynomB, and stands twice among its elements."""
    fields = {"K": [("PolynomB", 2)], "PolynomA": [("PolynomA", 2)]}[group["field"]]
    elements = group["elements"]
    if has_k(group):
        fields, elements = [("K", 1), *fields], elements[::2]
    return structs([{"ElemIndex": float(one + 1), "FieldName": name, "FieldIndex": cells([1.0, float(at)]), "Function": "x", "Args": cells([]), "SavedValue": 0.0}
                    for one in elements for name, at in fields])


def fitted(lattice, groups, first, last):
    """Strengths of the last iteration: the lattice of the file is the fitted one."""
    for group, value in zip(groups, last):
        for one in group["elements"]:
            if group["field"] == "K":
                lattice[one] |= {"K": value} if "K" in lattice[one] else {}
                lattice[one]["PolynomB"] = lattice[one]["PolynomB"] * [1, 0, 1] + [0, value, 0]
            else:
                lattice[one]["PolynomA"] = np.array([0.0, value, 0.0])


def loco_file(folder, path):
    """The LOCO file of a folder."""
    rows, monitors, correctors = (read(folder / name) for name in ("lattice.csv", "bpms.csv", "correctors.csv"))
    meta = json.loads((folder / "meta.json").read_text())
    fit = meta["reference_fit"]
    groups = fit["fit_parameters"]
    names = {"correctors": {rows[int(one["lattice_index"])]["name"] for one in correctors},
             "magnets": {rows[one]["name"] for group in groups for one in group["elements"]},
             "k": {row["name"] for row in rows} if all(map(has_k, (group for group in groups if group["field"] == "K"))) else set()}
    lattice = [element(row, names) for row in rows]
    start = lambda group: float(rows[group["elements"][0]]["k1_start_1_m2"]) if group["field"] == "K" else 0.0
    first = np.array(fit.get("values_start") or [start(group) for group in groups])
    last = np.array(fit.get("values_final") or first + 0.01)
    fitted(lattice, groups, first, last)
    if "energy_GeV" in meta and meta["energy_GeV"] is None:
        energy = {}
    else:
        energy = {"Energy": meta["energy_GeV"]}
    ring = structs([{"Lattice": cells([structs([one]) for one in lattice]), "CavityFrequency": meta["rf_Hz"], "CavityHarmNumber": 1.0} | energy])
    index = lambda table, plane: [int(one["lattice_index"]) + 1 for one in table if one["plane"] == plane]
    good = lambda table, plane: np.array([n + 1.0 for n, one in enumerate(one for one in table if one["plane"] == plane) if one["used_by_reference_fit"] == "1"])
    column = lambda values: np.array(values, dtype=float).reshape(-1, 1)
    all_monitors = sorted({int(one["lattice_index"]) + 1 for one in monitors})
    which = lambda plane: column([all_monitors.index(one) + 1 for one in index(monitors, plane)])
    kicks = lambda plane: column([float(one["nominal_kick_mrad"]) for one in correctors if one["plane"] == plane])
    steps = max(2, len(fit.get("chi2_per_iteration", [])))
    bpm = {"FamName": "BPM", "BPMIndex": column(all_monitors), "HBPMIndex": which("x"), "VBPMIndex": which("y")}
    cm = {"FamName": "COR", "HCMIndex": column(index(correctors, "x")), "VCMIndex": column(index(correctors, "y"))}
    gains = lambda step, name, count: column(fit.get(name, np.ones(count))) if step else np.ones((count, 1))
    found = lambda step, name, plane: column(fit[name]) if step and name in fit else kicks(plane)
    flags = fit["flags"]
    number = {name: float(flags[name]) for name in ("SVmethod", "OutlierFactor") if name in flags}
    variables = {
        "RINGData": ring,
        "BPMData": structs([bpm | {"HBPMGoodDataIndex": good(monitors, "x"), "VBPMGoodDataIndex": good(monitors, "y"), "HBPMGain": gains(step, "bpm_gain_x", len(index(monitors, "x"))),
                                   "VBPMGain": gains(step, "bpm_gain_y", len(index(monitors, "y")))} for step in range(steps)]),
        "CMData": structs([cm | {"HCMGoodDataIndex": good(correctors, "x"), "VCMGoodDataIndex": good(correctors, "y"), "HCMKicks": found(step, "corrector_kick_x_mrad", "x"),
                                 "VCMKicks": found(step, "corrector_kick_y_mrad", "y")} for step in range(steps)]),
        "LocoMeasData": structs([{"M": numbers(folder / "orm_measured_mm.csv"), "BPMSTD": column([float(one["sigma_mm"]) for one in monitors]),
                                  "Eta": numbers(folder / "dispersion_orbit_mm.csv"), "RF": meta["rf_Hz"], "DeltaRF": meta["delta_rf_Hz"]}]),
        "FitParameters": structs([{"Params": cells([parameter(group) for group in groups]), "Values": column(values), "DeltaRF": meta["delta_rf_Hz"]}
                                  for values in [first] + [last] * (steps - 1)]),
        "LocoModel": structs([{"M": [], "ChiSquare": value} for value in fit.get("chi2_per_iteration", [[]] * steps)]),
        "LocoFlags": structs([flags | number] * steps),
    }
    savemat(path, variables, oned_as="column", do_compression=True)
    if shutil.which("octave"):
        subprocess.run(["octave", "-qf", "--eval", OCTAVE.format(file=path)], check=True, capture_output=True)


def same(own, other, path, problems, tolerance):
    """Values of JSON, numbers by the tolerance; what only one of them has is ignored, as in the folder."""
    if isinstance(own, dict):
        for key in own.keys() & other.keys():
            same(own[key], other[key], f"{path}.{key}", problems, tolerance)
    elif isinstance(own, list):
        if len(own) != len(other):
            problems.append(f"{path}: {len(own)} and {len(other)}")
        for number, pair in enumerate(zip(own, other)):
            same(*pair, f"{path}[{number}]", problems, tolerance)
    elif isinstance(own, (int, float)) and isinstance(other, (int, float)):
        if abs(own - other) > tolerance * max(1, abs(own)):
            problems.append(f"{path}: {own} and {other}")
    elif own != other:
        problems.append(f"{path}: {own} and {other}")


def differences(folder, made):
    """Every field that is not the same in both folders."""
    problems = []
    for name in ("lattice.csv", "bpms.csv", "correctors.csv"):
        both = [read(one / name) for one in (folder, made)]
        if len(both[0]) != len(both[1]):
            problems.append(f"{name}: {len(both[0])} and {len(both[1])} rows")
        for row, (own, other) in enumerate(zip(*both)):
            for key in own.keys() & other.keys():
                try:
                    tolerance = POSITION if key == "s_entrance_m" else ROUNDING[name] * abs(float(own[key]))
                    far = abs(float(own[key]) - float(other[key])) > tolerance
                except ValueError:
                    far = own[key] != other[key]
                if far:
                    problems.append(f"{name} row {row} {key}: {own[key]} and {other[key]}")
    for name in ("orm_measured_mm.csv", "dispersion_orbit_mm.csv"):
        if not np.array_equal(numbers(folder / name), numbers(made / name), equal_nan=True):
            problems.append(f"{name}: other numbers")
    same(*(json.loads((one / "meta.json").read_text()) for one in (folder, made)), "meta.json", problems, ROUNDING["meta.json"])
    return problems


def fit(orbitcal, folder):
    done = subprocess.run([orbitcal, "fit", folder, "--quiet", "--json", "-"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def check(orbitcal, folder):
    with tempfile.TemporaryDirectory() as temporary:
        path, made = Path(temporary) / "loco.mat", Path(temporary) / folder.name
        loco_file(folder, path)
        done = subprocess.run([orbitcal, "import", path, "--out", made, "--quiet", "--json", "-"], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        problems = differences(folder, made)
        same(fit(orbitcal, folder), fit(orbitcal, made), "fit", problems, FIT)
    print(f"{folder.name:24} LOCO file {'as the folder, and its fit' if not problems else 'DIFFERS: ' + '; '.join(problems[:5])}", flush=True)
    return not problems


def main(arguments):
    if arguments[0] != "--check":
        loco_file(Path(arguments[0]), arguments[1])
        return 0
    return 0 if all([check(Path(arguments[1]).resolve(), Path(one).resolve()) for one in arguments[2:]]) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
