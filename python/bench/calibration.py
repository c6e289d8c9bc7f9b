"""Simulation-based calibration of a recording's machine: whether the posteriors of batch fit, core and NUTS are right, var by var.

Usage: calibration.py RECORDING FOLDER [campaigns] [method ...]      a stopped run goes on; the figure is FOLDER/calibration.svg
"""

import sys

import orbitcal
from orbitcal import ensemble

template, folder, *rest = sys.argv[1:]
count, methods = int(rest[0]) if rest else 2000, rest[1:] or ["map", "core", "nuts"]
recording = orbitcal.Recording.read(template)

DRAWS = 100  # of NUTS; 20 bins need no more

if __name__ == "__main__":
    table = ensemble.run(ensemble.Calibration(recording, methods, draws=DRAWS), range(count), folder)
    tested = ensemble.uniformity(table, recording.ring)
    print(f"{len(table)} campaigns, {len(ensemble.failures(folder))} set aside, {len(tested)} tests")
    for method, of_method in tested.groupby(level="method"):
        uniform, worst = of_method["is_uniform"], of_method["p"].idxmin()
        print(
            f"{method:5} uniform {uniform.sum()} of {len(uniform)}, chi2 {of_method['chi2'].mean():.1f} on average (19 expected), "
            f"{of_method['chi2'].max():.1f} at most, of {worst[1]}, p {of_method['p'].min():.1e}"
        )
    print(f"{ensemble.costs(folder)['seconds'].median():.2f} s a campaign (median)")
    ensemble.histograms(table).savefig(f"{folder}/calibration.svg")
