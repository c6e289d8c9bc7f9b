"""Differences of frame pairs for BoosterUQ, and what orbitcal's twin makes of the same numbers.

    python tests/peers/boosteruq_pairs.py recordings/paper-vars target/boosteruq   (numpy; the program built)
    julia tests/peers/boosteruq.jl PATH/TO/BoosterUQ target/boosteruq/pairs.csv       (the environment of BoosterUQ)

BoosterUQ compares orbits with readings; a recording has monitor offsets and a closed orbit that nobody knows. So each corrector gives one pair of
frames, its first at -22 A and its first at +22 A: their readings differ as the orbit does which the difference of all correctors' currents makes, and
have sqrt(2) times the noise. Main currents are the mean of both. Both programs take a lognormal prior of 3 % about 1; the answer here is the
Gaussian about the maximum, with derivatives by differences.
"""

import csv
import json
import math
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
ORBITCAL = ROOT / "target/release/orbitcal"
NOISE = math.sqrt(2) * 0.15  # mm
PRIOR = 0.03
KICK = 9.75e-5 / 7.7183  # rad/A
FAULTY = {"x_C6_mm", "y_B5_mm"}  # noisy, and jumping


def pairs(folder):
    """Frames of each corrector at -22 A and +22 A: currents by column, readings [mm]."""
    frames = list(csv.DictReader((folder / "frames.csv").open()))
    first = {}
    for frame in frames:
        first.setdefault((frame["corrector"], frame["setting_A"]), frame)
    both = [(first.get((name, "-22")), first.get((name, "22"))) for name in dict.fromkeys(f["corrector"] for f in frames)]
    return frames[0].keys(), [pair for pair in both if all(pair)]


def table(folder):
    """Currents and readings of the differences; rows with a missing reading of a sound monitor are left out."""
    names, all_pairs = pairs(folder)
    correctors = [name for name in names if name.startswith("ic_")]
    monitors = [name for name in names if name.endswith("_mm")]
    main = ["i_dipole_A", "i_qhc_A", "i_qvc_A", "i_sh_A", "i_sv_A"]
    number = lambda frame, name: float(frame[name]) if frame[name] else math.nan
    rows = []
    for low, high in all_pairs:
        mean = [0.5 * (number(low, name) + number(high, name)) for name in main]
        current = [number(high, name) - number(low, name) for name in correctors]
        reading = [number(high, name) - number(low, name) for name in monitors]
        if all(math.isfinite(x) for x, name in zip(reading, monitors) if name not in FAULTY):
            rows.append(mean + current + [0.0 if name in FAULTY else x for x, name in zip(reading, monitors)])
    return main, correctors, monitors, np.array(rows)


def response(names, params, monitors):
    """Response of the read monitors to all correctors [mm/rad]."""
    with tempfile.NamedTemporaryFile("w", suffix=".json") as file:
        json.dump(dict(zip(names, np.exp(params), strict=True)), file)
        file.flush()
        done = subprocess.run([ORBITCAL, "response", "--machine", ROOT / "machines/booster-deck.json", "--vars", file.name, "--json", "-"], capture_output=True, check=True)
    made = json.loads(done.stdout)
    at = {label: i for i, label in enumerate(made["bpm"])}
    planes = {plane: np.array(made[f"response_{plane}_m_per_rad"]) for plane in "xy"}
    return 1e3 * np.array([planes[plane][at[label]] for plane, label, _ in (name.split("_") for name in monitors)])


def fit(names, rows, monitors, start, count):
    kicks, read = KICK * rows[:, start : start + count], rows[:, start + count :]
    weight = np.array([0.0 if name in FAULTY else 1.0 / NOISE for name in monitors])
    orbit = lambda params: (kicks @ response(names, params, monitors).T * weight).ravel()
    params, data = np.zeros(len(names)), (read * weight).ravel()
    for _ in range(4):
        here, step = orbit(params), 1e-4
        columns = [(orbit(params + step * unit) - orbit(params - step * unit)) / (2 * step) for unit in np.eye(len(names))]
        slope = np.array(columns).T
        precision = slope.T @ slope + np.eye(len(names)) / PRIOR**2
        params = params + np.linalg.solve(precision, slope.T @ (data - here) - params / PRIOR**2)
    left = data - orbit(params)
    return params, np.linalg.inv(precision), left @ left / np.count_nonzero(np.tile(weight, len(rows)))


def main():
    folder, out = Path(sys.argv[1]), Path(sys.argv[2])
    out.mkdir(parents=True, exist_ok=True)
    main_currents, correctors, monitors, rows = table(folder)
    with (out / "pairs.csv").open("w") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*main_currents, *correctors, *monitors])
        writer.writerows([[f"{x:.6g}" for x in row] for row in rows])
    truth = json.loads((folder / "truth.json").read_text())["vars"]
    params, covariance, chi2 = fit(list(truth), rows, monitors, len(main_currents), len(correctors))
    sigma = np.sqrt(np.diag(covariance))
    off = params - np.log(list(truth.values()))
    with (out / "orbitcal.csv").open("w") as file:
        file.write("var,mean,sigma\n")
        for name, param, s in zip(truth, params, sigma, strict=True):
            file.write(f"{name},{math.exp(param):.5f},{math.exp(param) * s:.5f}\n")
    nees = off @ np.linalg.solve(covariance, off) / len(off)
    print(f"{len(rows)} pairs, chi2 over readings {chi2:.3f}, NEES/48 {nees:.2f}")
    print(f"mean sigma {100 * sigma[:24].mean():.2f} % (QH), {100 * sigma[24:].mean():.2f} % (QV); {out}")


if __name__ == "__main__":
    main()
