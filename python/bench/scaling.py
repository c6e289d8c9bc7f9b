"""An ensemble by one worker, and by one a core of which one is killed -9 halfway: the same table, bit for bit, and how much sooner.

Usage: scaling.py RECORDING FOLDER [campaigns [MACHINE]]      MACHINE: the machine file, if it is not the Booster
"""

import os
import shutil
import signal
import sys
import threading
import time

import orbitcal
import pandas as pd
from distributed import Client, LocalCluster
from orbitcal import ensemble

template, folder, *rest = sys.argv[1:]
count = int(rest[0]) if rest else 1000
ring = orbitcal.Ring(rest[1]) if rest[1:] else None


def timed(workers, is_killed):
    """The table, the seconds that it took, and the seconds that its tasks took in sum."""
    to = f"{folder}/{workers}-{'killed' if is_killed else 'whole'}"
    shutil.rmtree(to, ignore_errors=True)
    with LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=":0") as cluster, Client(cluster) as client:
        task = ensemble.Calibration(orbitcal.Recording.read(template, ring), ["map", "core"])
        if is_killed:
            threading.Thread(target=kill, args=(client, to), daemon=True).start()
        start = time.perf_counter()
        table = ensemble.run(task, range(count), to, client=client)
        seconds = time.perf_counter() - start
    return table, seconds, ensemble.costs(to)


def kill(client, to):
    """One of the workers, when half of the rows are there."""
    while len(ensemble.costs(to)) < count / 2:
        time.sleep(0.2)
    worker = next(iter(client.run(os.getpid).values()))
    os.kill(worker, signal.SIGKILL)
    print(f"killed -9: worker {worker}")


if __name__ == "__main__":
    cores = os.cpu_count()
    alone, seconds_alone, costs_alone = timed(1, is_killed=False)
    for is_killed in (False, True):
        table, seconds, costs = timed(cores, is_killed)
        pd.testing.assert_frame_equal(table, alone, check_exact=True)
        busy = costs["seconds"].sum() / (cores * seconds)
        slower = costs["seconds"].median() / costs_alone["seconds"].median()
        print(
            f"{len(table)} campaigns, the same bits: 1 worker {seconds_alone:.1f} s, {cores} workers{', one killed,' if is_killed else ''} {seconds:.1f} s: "
            f"{100 * seconds_alone / (cores * seconds):.0f} % of linear; workers are busy {100 * busy:.0f} % of the time, a task takes {slower:.2f} times as long beside another"
        )
