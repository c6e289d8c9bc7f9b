"""Ensembles: the same table whoever computes it, nothing lost, poison set aside."""

import os
import signal
import threading
import time

import numpy as np
import pandas as pd
import pytest
from conftest import RECORDINGS
from distributed import Client, LocalCluster

import orbitcal
from orbitcal import ensemble
from orbitcal.ensemble import engine


@pytest.fixture(scope="module")
def ten_cells():
    """A small ring, whose campaigns take some milliseconds."""
    ring = orbitcal.Ring(RECORDINGS / "ten-cells/ring.json")
    return orbitcal.Recording.read(RECORDINGS / "ten-cells/plain", ring)


@pytest.fixture(scope="module")
def cluster():
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster, Client(cluster) as client:
        yield client


class Toy:
    """The square of a seed; some seeds are poison."""

    name = "toy"

    def __init__(self, raising=(), killing=(), waiting=0.0):
        self.raising, self.killing, self.waiting = raising, killing, waiting
        self.says = {"version": 1}

    def __call__(self, seed):
        time.sleep(self.waiting)
        if seed in self.raising:
            raise ValueError(f"seed {seed} is odd")
        if seed in self.killing:
            os.kill(os.getpid(), signal.SIGKILL)
        return {"square": seed * seed}


def test_a_table_does_not_depend_on_who_computed_it(ten_cells, cluster, tmp_path, monkeypatch):
    """One worker, and two of which one is killed -9 halfway."""
    monkeypatch.setattr(engine, "ROWS", 1)  # a part after each row, so that it is known when to kill
    task = ensemble.Calibration(ten_cells, ["map", "core"])
    alone = ensemble.run(task, range(40), tmp_path / "alone", workers=1, progress=False)
    folder, killed = tmp_path / "both", []

    def kill():
        while not killed:
            if len(ensemble.costs(folder)) >= 20:
                killed.append(next(iter(cluster.run(os.getpid).values())))
                os.kill(killed[0], signal.SIGKILL)
            time.sleep(0.05)

    thread = threading.Thread(target=kill)
    thread.start()
    both = ensemble.run(task, range(40), folder, client=cluster, progress=False)
    thread.join()
    assert killed
    pd.testing.assert_frame_equal(both, alone, check_exact=True)
    # what cannot be fitted is set aside, the same by both
    set_aside = ensemble.failures(folder)
    pd.testing.assert_frame_equal(set_aside, ensemble.failures(tmp_path / "alone"))
    assert sorted([*both["seed"], *set_aside.get("seed", [])]) == list(range(40)) and len(both) > 35


def test_a_run_goes_on_where_it_was(cluster, tmp_path):
    ensemble.run(Toy(), range(10), tmp_path, client=cluster, progress=False)
    before = ensemble.costs(tmp_path)
    table = ensemble.run(Toy(), range(20), tmp_path, client=cluster, progress=False)
    assert list(table["square"]) == [seed * seed for seed in range(20)]
    pd.testing.assert_frame_equal(ensemble.costs(tmp_path).iloc[:10], before)
    # a file that a kill has left half written is no part
    (tmp_path / "rows/half.partial").write_bytes(b"PAR1")
    assert len(ensemble.run(Toy(), range(20), tmp_path, client=cluster, progress=False)) == 20


def test_workers_that_come_late_have_work_too(tmp_path):
    """A cluster gives its workers when it has them: here none is there at first, and then six."""

    def task(seed):
        start = time.time()
        time.sleep(0.3)
        return {"start": start, "end": time.time()}

    with (
        LocalCluster(n_workers=0, threads_per_worker=1, processes=False, dashboard_address=":0") as cluster,
        Client(cluster) as client,
    ):
        threading.Timer(1.0, cluster.scale, [6]).start()
        table = ensemble.run(task, range(48), tmp_path, client=client, progress=False)
    at_once = [((table["start"] <= start) & (start < table["end"])).sum() for start in table["start"]]
    assert max(at_once) == 6


def test_poison_is_set_aside_with_its_error(cluster, tmp_path):
    task = Toy(raising=[5], killing=[3])
    table = ensemble.run(task, range(8), tmp_path, client=cluster, progress=False)
    assert list(table["seed"]) == [0, 1, 2, 4, 6, 7]
    said = ensemble.failures(tmp_path).set_index("seed")["error"]
    assert said[5] == "ValueError: seed 5 is odd" and said[3].startswith("KilledWorker")
    # and is not tried again
    assert len(ensemble.run(task, range(8), tmp_path, client=cluster, progress=False)) == 6


def test_a_result_that_was_lost_with_its_worker_is_waited_for():
    class Lost:
        key, status = "toy-2", "pending"  # finished before, made again now

        def result(self):
            return 2, {"square": 4}, "", 0.1, "host:1"

        def exception(self):
            return None

    assert engine._result(Lost())[1] == {"square": 4}


def test_results_of_another_task_are_not_mixed(ten_cells, cluster, tmp_path):
    ensemble.run(Toy(), range(2), tmp_path, client=cluster, progress=False)
    with pytest.raises(orbitcal.InputError, match="expected results of .*calibration.*found those of .*toy"):
        ensemble.run(ensemble.Calibration(ten_cells), range(2), tmp_path, client=cluster, progress=False)


def test_a_validation_is_that_of_the_program(booster, cluster, tmp_path):
    """Two campaigns of `orbitcal validate recordings/paper-vars --empty 0 --single 2 --pair 0 --unknown 0 --seed 1`, by its outcomes."""
    template = orbitcal.Recording.read(RECORDINGS / "paper-vars", booster)
    table = ensemble.run(ensemble.Validation(template, "single"), [0, 1], tmp_path, client=cluster, progress=False)
    assert [list(one) for one in table["made"]] == [["dipole_sextupole=-0.1495"], ["momentum_offset=-0.0010"]]
    assert list(table["verdict"]) == ["consistent", "ambiguous"] and list(table["grade"]) == ["missed", "open"]
    assert list(table["found"].iloc[1]) == ["corrector_crosstalk@V_A1"]


def test_a_calibration_of_the_prior_alone_is_uniform(ten_cells):
    """What is not calibrated is seen: probabilities of a posterior that is half as wide are not uniform."""
    random = np.random.default_rng(1)
    n = len(ten_cells.ring.vars)
    from scipy.stats import norm

    pulls = random.normal(size=(2000, n))
    right = pd.DataFrame({"right": list(norm.cdf(pulls)), "narrow": list(norm.cdf(2 * pulls))})
    tested = ensemble.uniformity(right, ten_cells.ring)
    assert tested.loc["right", "is_uniform"].all() and not tested.loc["narrow", "is_uniform"].any()


def test_a_training_set_has_vars_and_responses(ten_cells, cluster, tmp_path):
    table = ensemble.run(ensemble.TrainingSet(ten_cells), range(4), tmp_path, client=cluster, progress=False)
    row, ring = table.iloc[2], ten_cells.ring
    response = ring.with_vars(dict(zip(ring.vars.index, row["vars"], strict=True))).response()
    np.testing.assert_array_equal(np.reshape(row["response"], response.shape), response)
