"""Ensembles: the same table whoever computes it, nothing lost, poison set aside."""

import functools
import json
import os
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from contextlib import contextmanager

import numpy as np
import pandas as pd
import pytest
from conftest import RECORDINGS
from distributed import Client, Future, LocalCluster
from scipy.stats import kstest, norm

import orbitcal
from orbitcal import ensemble
from orbitcal.ensemble import engine, store, tasks


@pytest.fixture(scope="module")
def ten_cells():
    """A small ring, whose campaigns take some milliseconds."""
    ring = orbitcal.Ring(RECORDINGS / "ten-cells/ring.json")
    return orbitcal.Recording.read(RECORDINGS / "ten-cells/plain", ring)


@pytest.fixture(scope="module")
def cluster():
    """Two workers, as `run` starts them."""
    with engine._client(None, 2) as client:
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
    monkeypatch.setattr(store, "ROWS", 1)  # a part after each row, so that it is known when to kill
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


def test_workers_that_come_late_have_work_too(tmp_path, monkeypatch):
    """A cluster gives its workers when it has them: here none is there at first, and then six, before the first result."""
    monkeypatch.setattr(engine, "LOOK", 0.2)

    def task(seed):
        start = time.time()
        time.sleep(4.0)
        return {"start": start, "end": time.time()}

    with (
        LocalCluster(n_workers=0, threads_per_worker=1, processes=False, dashboard_address=":0") as cluster,
        Client(cluster) as client,
    ):
        threading.Timer(0.5, cluster.scale, [6]).start()
        table = ensemble.run(task, range(7), tmp_path, client=client, progress=False)
    at_once = [((table["start"] <= start) & (start < table["end"])).sum() for start in table["start"]]
    assert max(at_once) == 6


def test_poison_is_set_aside_with_its_error(cluster, tmp_path):
    task = Toy(raising=[5], killing=[3])
    table = ensemble.run(task, range(8), tmp_path, client=cluster, progress=False)
    assert list(table["seed"]) == [0, 1, 2, 4, 6, 7]
    said = ensemble.failures(tmp_path).set_index("seed")["error"]
    assert list(said.index) == [3, 5]
    assert said[5] == "ValueError: seed 5 is odd" and said[3].startswith("KilledWorker")
    # and is not tried again
    assert len(ensemble.run(task, range(8), tmp_path, client=cluster, progress=False)) == 6


def test_workers_that_are_gone_are_replaced(tmp_path):
    """A worker that dies as it starts takes its nanny with it; here both nannies have ended before the run."""
    with engine._client(None, 2) as client:
        for nanny in list(client.cluster.workers.values()):
            client.cluster.sync(nanny.close)
        assert len(ensemble.run(Toy(), range(8), tmp_path, client=client, progress=False)) == 8


def test_what_dask_cancels_is_run_again(cluster, tmp_path):
    """All that is out is cancelled while the run goes on; no seed is to blame."""

    def cancel():
        end = time.monotonic() + 60
        while not cancelled and time.monotonic() < end:
            time.sleep(0.05)
            cancelled.extend(key for key, state in list(cluster.futures.items()) if state.status == "pending")
        cluster.cancel([Future(key, cluster) for key in cancelled], force=True)

    cancelled, thread = [], threading.Thread(target=cancel)
    thread.start()
    table = ensemble.run(Toy(waiting=0.2), range(12), tmp_path, client=cluster, progress=False)
    thread.join()
    assert cancelled and len(table) == 12 and ensemble.failures(tmp_path).empty


def test_what_is_lost_on_its_way_is_run_again(cluster, tmp_path, monkeypatch):
    fetched, lost = Future.result, []

    def result(future):
        if len(lost) < 3:
            lost.append(future.key)
            raise OSError("connection closed")
        return fetched(future)

    def gather(futures):
        raise OSError("connection closed")

    monkeypatch.setattr(Future, "result", result)
    monkeypatch.setattr(cluster, "gather", gather)
    table = ensemble.run(Toy(), range(6), tmp_path, client=cluster, progress=False)
    assert len(table) == 6 and len(lost) == 3 and ensemble.failures(tmp_path).empty
    # and what is always lost ends the run
    lost.extend([""] * 3)
    monkeypatch.setattr(Future, "result", gather)
    with pytest.raises(orbitcal.OrbitcalError, match="seed 7: dask cancelled or lost it 10 times"):
        ensemble.run(Toy(), [7], tmp_path, client=cluster, progress=False)
    assert ensemble.failures(tmp_path).empty


class Unloadable(Toy):
    """A task that no worker can load, as of a package that it lacks."""

    def __reduce__(self):
        return _load, ()


def _load():
    raise ModuleNotFoundError("No module named 'of_mine'")


def test_an_error_of_a_worker_ends_the_run_and_is_no_seed_s(cluster, tmp_path):
    with pytest.raises(ModuleNotFoundError):
        ensemble.run(Unloadable(), range(4), tmp_path, client=cluster, progress=False)
    assert ensemble.failures(tmp_path).empty


def test_a_worker_waits_for_its_task(tmp_path, monkeypatch):
    """One that has just started may be given a seed before the task."""
    carried, pause = engine._carried, [1.0]

    @contextmanager
    def late(client, task):
        with carried(client, task) as name:
            worker = next(iter(client.cluster.workers.values()))
            carrier = worker.plugins.pop(name)
            threading.Timer(pause[0], worker.plugins.update, [{name: carrier}]).start()
            yield name

    monkeypatch.setattr(engine, "_carried", late)
    cluster = LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=":0")
    with cluster, Client(cluster) as client:
        assert len(ensemble.run(Toy(), range(4), tmp_path, client=client, progress=False)) == 4
        monkeypatch.setattr(engine, "PATIENCE", 0.1)
        with pytest.raises(RuntimeError, match="was not given the task"):
            ensemble.run(Toy(), range(8), tmp_path, client=client, progress=False)
    assert ensemble.failures(tmp_path).empty


def odd(seed):
    """Rows of several sorts, some of which no table can hold."""
    rows = {3: {"x": "none"}, 5: {"x": np.zeros((2, 2))}, 6: {"seed": 1}, 7: None, 8: {"x": {}}}
    return rows.get(seed, {"x": seed})


def test_a_row_that_no_table_holds_is_set_aside(cluster, tmp_path):
    for _ in range(2):  # and so when it is taken up
        table = ensemble.run(odd, range(-1, 10), tmp_path, client=cluster, progress=False)
        assert dict(zip(table["seed"], table["x"])) == {-1: -1, 0: 0, 1: 1, 2: 2, 3: "none", 4: 4, 9: 9}
        said = ensemble.failures(tmp_path).set_index("seed")["error"]
        assert list(said.index) == [5, 6, 7, 8]
        assert said[5].startswith("ArrowInvalid") and said[6].startswith("ValueError: a row has no column seed")
        assert said[7] == "TypeError: expected a row as a dictionary, found NoneType"


def test_a_negative_seed_is_set_aside_under_its_name(ten_cells, cluster, tmp_path):
    task = ensemble.TrainingSet(ten_cells)
    table = ensemble.run(task, [-5, 5], tmp_path, client=cluster, progress=False)
    assert list(table["seed"]) == [5] and list(ensemble.failures(tmp_path)["seed"]) == [-5]


def uneven(seed):
    """Rows without a column, with an empty cell, with whole numbers."""
    row = {"gain": None if seed % 3 else 0.5 if seed % 2 else 1, "names": ["a"] * (seed % 2), "values": [0.5] * (seed % 4)}
    return row if seed % 4 else {"first": seed, **row}


def test_a_table_does_not_depend_on_its_parts(tmp_path):
    tables = []
    for size in (1, 2, 5, 100):
        folder, seeds = tmp_path / str(size), np.random.default_rng(size).permutation(24).tolist()
        for start in range(0, 24, size):
            held = store.Store(folder, uneven)
            for seed in seeds[start : start + size]:
                held.take(seed, store.row_of(seed, uneven(seed)), "", 0.1, "host:1")
            held.flush()
        tables.append(store.table_of(folder / "rows"))
    assert list(tables[0].columns) == ["seed", "first", "gain", "names", "values"] and len(tables[0]) == 24
    assert tables[0]["gain"].dtype == float
    for other in tables[1:]:
        pd.testing.assert_frame_equal(other, tables[0], check_exact=True)


def square(seed, power=2):
    return {"x": seed**power}


class Says(Toy):
    """A task that says what JSON gives back as something else."""

    says = {"limits": (0, 1), "noise": float("nan")}

    def __init__(self):
        self.raising, self.killing, self.waiting = (), (), 0.0


def test_results_of_another_task_are_not_mixed(ten_cells, tmp_path):
    other = orbitcal.Recording.simulated(ten_cells, 1)[0]
    narrow = orbitcal.Ring(RECORDINGS / "ten-cells/ring.json").with_priors(width=0.001)
    same = orbitcal.Recording.read(RECORDINGS / "ten-cells/plain", orbitcal.Ring(RECORDINGS / "ten-cells/ring.json"))
    tasks = [
        Toy(),
        odd,
        square,
        functools.partial(square, power=3),
        functools.partial(square, power=4),
        ensemble.Calibration(ten_cells),
        ensemble.Calibration(orbitcal.Recording.read(RECORDINGS / "ten-cells/plain", narrow)),
        ensemble.Calibration(orbitcal.Recording(other._recording, ten_cells.ring)),
        ensemble.TrainingSet(ten_cells),
    ]
    for place, task in enumerate(tasks):
        store.Store(tmp_path / str(place), task)
        for another in tasks[:place] + tasks[place + 1 :]:
            with pytest.raises(orbitcal.InputError, match="expected results of .*, found those of"):
                store.Store(tmp_path / str(place), another)
    store.Store(tmp_path / "5", ensemble.Calibration(same))
    store.Store(tmp_path / "says", Says())
    store.Store(tmp_path / "says", Says())


def test_what_task_a_folder_is_of_appears_whole(tmp_path, monkeypatch):
    """A run that is killed while it writes leaves no half of `task.json`."""
    monkeypatch.setattr(store.os, "replace", lambda *_: None)
    store.Store(tmp_path, square)
    assert not (tmp_path / "task.json").exists()
    monkeypatch.undo()
    store.Store(tmp_path, square)
    assert json.loads((tmp_path / "task.json").read_text())["task"].endswith(".square")


def test_a_client_need_not_be_dask_s_default(tmp_path):
    cluster = LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=":0")
    with cluster, Client(cluster, set_as_default=False) as client:
        assert len(ensemble.run(Toy(), range(4), tmp_path, client=client, progress=False)) == 4


def test_the_dashboard_is_there(cluster):
    page = urllib.request.urlopen(cluster.dashboard_link, timeout=20).read().decode()
    assert "bokeh.min.js" in page  # without bokeh it says that it needs it


SCRIPT = """
import sys
from orbitcal import ensemble

def square(seed):
    return {"x": seed**2}

GUARD
    print(ensemble.run(square, range(3), sys.argv[1], workers=1, progress=False)["x"].tolist())
"""


@pytest.mark.parametrize("guard", ['if __name__ == "__main__":', "if True:"])
def test_a_script_needs_a_guard_and_is_told(guard, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.replace("GUARD", guard))
    ran = subprocess.run([sys.executable, script, tmp_path / "out"], capture_output=True, text=True, timeout=300)
    if guard == "if True:":
        assert ran.returncode != 0 and ran.stderr.strip().endswith("as each worker imports the script")
    else:
        assert ran.stdout.strip() == "[0, 1, 4]", ran.stderr


def test_a_case_without_a_beam_has_all_columns(ten_cells):
    class NoBeam:
        def run(self, *_):
            return None

    task = ensemble.Validation(ten_cells, "single")
    task._validation = NoBeam()
    assert list(task(1)) == list(task.COLUMNS) and task(1)["verdict"] == "no beam"


def test_a_validation_is_that_of_the_program(booster, cluster, tmp_path):
    """Two campaigns of `orbitcal validate recordings/former/paper-vars --empty 0 --single 2 --pair 0 --unknown 0 --seed 1`, by its outcomes."""
    template = orbitcal.Recording.read(RECORDINGS / "former/paper-vars", booster)
    table = ensemble.run(ensemble.Validation(template, "single"), [0, 1], tmp_path, client=cluster, progress=False)
    made = [["bpm_swap@y_A5,y_A7"], ["corrector_polarity@H_B4"]]
    assert [list(one) for one in table["made"]] == made and [list(one) for one in table["found"]] == made
    assert list(table["verdict"]) == ["identified"] * 2 and list(table["grade"]) == ["right"] * 2


def test_a_calibration_is_uniform(ten_cells, cluster, tmp_path):
    """Probabilities of batch fit and core over 60 campaigns, var by var and of all 20 vars together; those of half the width are not uniform."""
    table = ensemble.run(ensemble.Calibration(ten_cells, ["map", "core"]), range(60), tmp_path, client=cluster, progress=False)
    assert len(table) == 60
    for method in ("map", "core"):
        made = np.stack(table[method])
        assert made.shape[1] == len(ten_cells.ring.vars) == 20
        assert min(kstest(of_var, "uniform").pvalue for of_var in made.T) > 1e-4
        assert kstest(made.ravel(), "uniform").pvalue > 1e-4
        narrow = norm.cdf(2 * norm.ppf(made.ravel()))
        assert kstest(narrow, "uniform").pvalue < 1e-10


def test_places_among_few_draws_are_uniform():
    """Of a value among draws of its own distribution, 3 a value: by their number alone 20 bins would be filled in four places."""
    values, draws = np.random.default_rng(5).normal(size=(20_000, 1)), np.random.default_rng(6).normal(size=(20_000, 3))
    below = (draws < values).sum(axis=1)
    made = np.array(tasks._place(below, 3, seed=7))
    assert kstest(made, "uniform").pvalue > 1e-4
    assert (np.floor(made * 4) == below).all()
    assert kstest(below / 3, "uniform").pvalue < 1e-10


def test_probabilities_far_outside_the_prior_are_numbers(ten_cells):
    """A posterior whose normal lies 30 widths beyond the range still has probabilities: those of its tail."""
    ring = ten_cells.ring
    low, high = np.log(ring._ring.priors[0][1:])
    middle = np.full(len(ring.vars), (low + high) / 2)
    for mean, expected in ((high + 3.0, 0.0), (low - 3.0, 1.0)):
        made = tasks._below(ring, middle, np.full(middle.shape, mean), np.full(middle.shape, 0.1))
        assert np.allclose(made, expected, atol=1e-6), made


def test_uniformity_sees_a_posterior_that_is_too_narrow(ten_cells):
    pulls = np.random.default_rng(1).normal(size=(2000, len(ten_cells.ring.vars)))
    right = pd.DataFrame({"right": list(norm.cdf(pulls)), "narrow": list(norm.cdf(2 * pulls))})
    tested = ensemble.uniformity(right, ten_cells.ring)
    assert tested.loc["right", "is_uniform"].all() and not tested.loc["narrow", "is_uniform"].any()


def test_a_training_set_has_vars_and_responses(ten_cells, cluster, tmp_path):
    table = ensemble.run(ensemble.TrainingSet(ten_cells), range(4), tmp_path, client=cluster, progress=False)
    row, ring = table.iloc[2], ten_cells.ring
    response = ring.with_vars(dict(zip(ring.vars.index, row["vars"], strict=True))).response()
    np.testing.assert_array_equal(np.reshape(row["response"], response.shape), response)
