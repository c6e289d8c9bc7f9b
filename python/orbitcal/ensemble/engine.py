"""The engine: seeds to workers, rows to Parquet; a run that stopped goes on where it was."""

from __future__ import annotations

import json
import os
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from .._orbitcal import InputError

if TYPE_CHECKING:
    from distributed import Client, Future

Task = Callable[[int], dict[str, Any]]
Costs = pd.DataFrame
Result = tuple[int, dict[str, Any] | None, str, float, str]  # seed, row, error, seconds, worker

AHEAD = 4  # tasks a thread of a worker that are handed out at once
LOOK = 1.0  # seconds after which the threads are counted again
ROWS = 200  # of a part at most
SECONDS = 10.0  # after which what has come is written, if it is less
FOLDERS = ("rows", "costs", "failures")


def run(
    task: Task,
    seeds: Iterable[int],
    folder: str | os.PathLike[str],
    *,
    client: Client | None = None,
    workers: int | None = None,
    progress: bool = True,
) -> pd.DataFrame:
    """Run a task for each seed and return the table of all rows, in the order of the seeds.

    `task(seed)` gives a row, the same whoever computes it. Rows are written to `folder/rows/*.parquet` as they come; a run that was
    stopped takes up the seeds that are missing. A worker that dies loses nothing: its seeds are given to others. A seed whose task raises, or that
    kills its worker when it is alone, is set aside with its error (`failures`). `client` is of any dask cluster; without one there are `workers`
    processes here, one a core by default. What it took stands in `costs`.
    """
    wanted = list(dict.fromkeys(int(seed) for seed in seeds))
    store = _Store(Path(folder), task)
    done = store.seeds()
    missing = [seed for seed in wanted if seed not in done]
    if missing:
        with _client(client, workers) as cluster:
            _all(task, missing, cluster, store, progress, len(wanted))
    table = store.table("rows")
    if table.empty:
        return table
    return table[table["seed"].isin(wanted)].sort_values("seed").reset_index(drop=True)


def failures(folder: str | os.PathLike[str]) -> pd.DataFrame:
    """Seeds that were set aside, with their errors."""
    return _table(Path(folder) / "failures")


def costs(folder: str | os.PathLike[str]) -> Costs:
    """What each row took: seconds and the process that computed it."""
    return _table(Path(folder) / "costs")


def _all(task: Task, seeds: list[int], client: Client, store: _Store, progress: bool, total: int) -> None:
    import cloudpickle
    from distributed import KilledWorker, as_completed
    from tqdm.auto import tqdm

    name = f"orbitcal-{uuid.uuid4().hex}"
    client.register_plugin(_carrier(name, cloudpickle.dumps(task)))
    ahead = _Ahead(client)
    rest = iter(seeds)
    submit = lambda seed, word="": client.submit(_one, name, seed, key=f"{name}{word}-{seed}", pure=False)
    suspects: list[int] = []
    try:
        with tqdm(total=total, initial=total - len(seeds), desc=store.what, disable=not progress) as bar:
            bar.set_postfix_str(client.dashboard_link or "")
            coming = as_completed([submit(seed) for seed in islice(rest, ahead.count())])
            for future in coming:
                try:
                    store.take(*_result(future))
                    bar.update()
                except KilledWorker:
                    suspects.append(_seed(future))
                future.release()
                for seed in islice(rest, max(0, ahead.count() - coming.count())):
                    coming.add(submit(seed))
            # dask suspects all that a worker held when it died; alone it is seen which of them kills
            for seed in suspects:
                try:
                    store.take(*_result(submit(seed, "-alone")))
                except KilledWorker as died:
                    store.take(*_failed(seed, died))
                bar.update()
    finally:
        store.flush()
        client.unregister_worker_plugin(name)


class _Ahead:
    """How many tasks may be out: workers come when a cluster has them, and go."""

    def __init__(self, client: Client) -> None:
        self.client, self._count, self._looked = client, 0, float("-inf")

    def count(self) -> int:
        if time.monotonic() - self._looked > LOOK:
            self._count = AHEAD * max(1, sum(self.client.nthreads().values()))
            self._looked = time.monotonic()
        return self._count


def _carrier(name: str, payload: bytes) -> Any:
    """The task on every worker, those that start later too: data that were sent once would be lost with a worker."""
    import cloudpickle
    from distributed import WorkerPlugin

    class Carrier(WorkerPlugin):
        def setup(self, worker: Any) -> None:
            self.task = cloudpickle.loads(payload)

    carrier = Carrier()
    carrier.name = name
    return carrier


def _one(name: str, seed: int) -> Result:
    """The row of a seed, or its error; on a worker."""
    from distributed import get_worker

    task = get_worker().plugins[name].task
    start = time.perf_counter()
    try:
        row, error = task(seed), ""
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as raised:  # a panic in Rust is no Exception
        row, error = None, f"{type(raised).__name__}: {raised}"
    return seed, row, error, time.perf_counter() - start, f"{os.uname().nodename}:{os.getpid()}"


def _seed(future: Future) -> int:
    return int(str(future.key).rsplit("-", 1)[1])


def _result(future: Future) -> Result:
    """What a worker said; it is waited for where dask makes a result again that was lost with its worker. `KilledWorker` if several have died of it."""
    from distributed import KilledWorker

    try:
        return future.result()
    except KilledWorker:
        raise
    except Exception as raised:
        return _failed(_seed(future), raised)


def _failed(seed: int, raised: Exception) -> Result:
    return seed, None, f"{type(raised).__name__}: {raised}".splitlines()[0], float("nan"), ""


@contextmanager
def _client(client: Client | None, workers: int | None) -> Iterator[Client]:
    if client is not None:
        yield client
        return
    from distributed import Client as Local
    from distributed import LocalCluster

    count = workers or os.cpu_count() or 1
    # a free port for the dashboard, as another run may have the usual one
    with (
        LocalCluster(n_workers=count, threads_per_worker=1, dashboard_address=":0") as cluster,
        Local(cluster) as local,
    ):
        yield local


class _Store:
    """Rows, costs and failures of one task in a folder."""

    def __init__(self, folder: Path, task: Task) -> None:
        self.folder, self.what = folder, getattr(task, "name", type(task).__name__)
        self._held: dict[str, list[dict[str, Any]]] = {name: [] for name in FOLDERS}
        self._written = time.monotonic()
        for name in FOLDERS:
            (folder / name).mkdir(parents=True, exist_ok=True)
        says = {"task": self.what, **getattr(task, "says", {})}
        path = folder / "task.json"
        if path.exists() and (found := json.loads(path.read_text())) != says:
            raise InputError(f"{folder}: expected results of {says}, found those of {found}")
        path.write_text(json.dumps(says, indent=2) + "\n")

    def take(self, seed: int, row: dict[str, Any] | None, error: str, seconds: float, worker: str) -> None:
        """One more result."""
        if row is None:
            self._held["failures"].append({"seed": seed, "error": error})
        else:
            self._held["rows"].append({"seed": seed, **row})
            self._held["costs"].append({"seed": seed, "seconds": seconds, "worker": worker})
        if len(self._held["rows"]) >= ROWS or time.monotonic() - self._written > SECONDS:
            self.flush()

    def flush(self) -> None:
        """Write what has come; a part appears whole or not at all, rows last, so that each has its cost."""
        part = uuid.uuid4().hex
        for name in reversed(FOLDERS):
            if self._held[name]:
                to = self.folder / name / f"{part}.parquet"
                pd.DataFrame(self._held[name]).to_parquet(to.with_suffix(".partial"), index=False)
                to.with_suffix(".partial").replace(to)
                self._held[name] = []
        self._written = time.monotonic()

    def seeds(self) -> set[int]:
        """Seeds that need not be run: those with a row, and those that were set aside."""
        tables = [self.table(name) for name in ("rows", "failures")]
        return {int(seed) for table in tables if not table.empty for seed in table["seed"]}

    def table(self, name: str) -> pd.DataFrame:
        return _table(self.folder / name)


def _table(folder: Path) -> pd.DataFrame:
    parts = sorted(folder.glob("*.parquet"))
    if not parts:
        return pd.DataFrame()
    table = pd.concat([pd.read_parquet(part) for part in parts], ignore_index=True)
    # a run that was killed between two parts has some twice, the same
    return table.drop_duplicates("seed").sort_values("seed").reset_index(drop=True)
