"""The engine: seeds to workers, rows to Parquet; a run that stopped goes on where it was."""

from __future__ import annotations

import multiprocessing
import os
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from .._orbitcal import InputError, OrbitcalError
from .store import Result, Store, Task, row_of, table_of

if TYPE_CHECKING:
    from distributed import Client, Future, KilledWorker

Costs = pd.DataFrame

AHEAD = 4  # tasks a thread of a worker that are out at once
LOOK = 2.0  # seconds after which the threads are counted again
PAUSE = 0.02  # seconds between two looks for results
PATIENCE = 60.0  # seconds that a worker waits for the task
LOST = 10  # times that dask may lose a seed
GUARD = (
    "no worker could be started; in a script the call of ensemble.run has to stand below `if __name__ == \"__main__\":`,"
    " as each worker imports the script"
)


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

    `task(seed)` gives a row as a dictionary, the same whoever computes it. Rows are written to `folder/rows/*.parquet` as they come; a run
    that was stopped takes up the seeds that are missing. A worker that dies loses nothing: its seeds are given to others. A seed whose task
    raises, whose row Parquet cannot hold, or that kills its worker when it is alone, is set aside with its error (`failures`). `client` is of
    any dask cluster; without one there are `workers` processes here, one a core by default. `costs` has what each row took.
    """
    if client is None and getattr(multiprocessing.current_process(), "_inheriting", False):
        raise InputError(GUARD)  # a worker that is being started has come here by the import of the script
    wanted = list(dict.fromkeys(int(seed) for seed in seeds))
    store = Store(Path(folder), task)
    done = store.seeds()
    missing = [seed for seed in wanted if seed not in done]
    if missing:
        with _client(client, workers) as cluster:
            _all(task, missing, cluster, store, progress, len(wanted))
    table = table_of(Path(folder) / "rows")
    if table.empty:
        return table
    return table[table["seed"].isin(wanted)].reset_index(drop=True)


def failures(folder: str | os.PathLike[str]) -> pd.DataFrame:
    """Seeds that were set aside, with their errors."""
    return table_of(Path(folder) / "failures")


def costs(folder: str | os.PathLike[str]) -> Costs:
    """What each row took: seconds and the process that computed it."""
    return table_of(Path(folder) / "costs")


def _all(task: Task, seeds: list[int], client: Client, store: Store, progress: bool, total: int) -> None:
    from distributed import KilledWorker
    from tqdm.auto import tqdm

    what = getattr(task, "name", getattr(task, "__name__", type(task).__name__))
    suspects: list[int] = []
    bar = tqdm(total=total, initial=total - len(seeds), desc=what, disable=not progress)
    with bar, _carried(client, task) as name:
        bar.set_postfix_str(client.dashboard_link or "")
        try:
            for seed, result in _results(client, name, seeds, _Ahead(client).count):
                if isinstance(result, KilledWorker):
                    suspects.append(seed)
                else:
                    store.take(*result)
                    bar.update()
            # dask suspects all that a worker held when it died; alone it is seen which seed kills its worker
            for seed, result in _results(client, name, suspects, lambda: 1):
                store.take(*(_killed(seed, result) if isinstance(result, KilledWorker) else result))
                bar.update()
        finally:
            store.flush()


def _results(
    client: Client, name: str, seeds: Iterable[int], ahead: Callable[[], int]
) -> Iterator[tuple[int, Result | KilledWorker]]:
    """What each seed came to, as it comes, `ahead()` of them out at once; what dask has cancelled or lost is given out again."""
    from distributed import as_completed

    rest, lost = iter(seeds), Counter[int]()
    out: dict[Any, int] = {}  # seed of each key
    coming = as_completed(loop=client.loop)  # the client need not be dask's default
    while True:
        for seed in islice(rest, max(0, ahead() - len(out))):
            # a key is new each time, as dask may still know one that was lost
            future = client.submit(_one, name, seed, key=f"{name}-{uuid.uuid4().hex}", pure=False)
            out[future.key] = seed
            coming.add(future)
        if not out:
            return
        # it does not block until the next result: workers may come before that does
        batch = coming.next_batch(block=False)
        if not batch:
            time.sleep(PAUSE)
        for future, result in zip(batch, _fetched(client, batch), strict=True):
            seed = out.pop(future.key)
            future.release()
            if result is not None:
                yield seed, result
                continue
            lost[seed] += 1
            if lost[seed] == LOST:
                raise OrbitcalError(f"seed {seed}: dask cancelled or lost it {LOST} times")
            rest = chain([seed], rest)


def _fetched(client: Client, futures: list[Future]) -> list[Result | KilledWorker | None]:
    """What workers said; one that dask makes again, as it was lost with its worker, is waited for."""
    try:
        return client.gather(futures)  # one message for all
    except Exception:
        return [_result(future) for future in futures]


def _result(future: Future) -> Result | KilledWorker | None:
    """What a worker said, or that several have died of it; none of what was cancelled or lost. Any other error is no seed's and is raised."""
    from distributed import KilledWorker

    try:
        return future.result()
    except KilledWorker as died:
        return died
    except (CancelledError, OSError):  # of dask, as `_one` raises neither; its errors of communication are OSErrors
        return None


class _Ahead:
    """How many tasks may be out: workers come when a cluster has them, and go."""

    def __init__(self, client: Client) -> None:
        self.client, self._count, self._looked = client, 0, float("-inf")

    def count(self) -> int:
        if time.monotonic() - self._looked > LOOK:
            self._count = AHEAD * max(1, sum(self.client.nthreads().values()))
            self._looked = time.monotonic()
        return self._count


@contextmanager
def _carried(client: Client, task: Task) -> Iterator[str]:
    """The task on every worker, those that start later too: data that were sent once would be lost with a worker."""
    import cloudpickle
    from distributed import WorkerPlugin

    payload, key = cloudpickle.dumps(task), f"orbitcal-{uuid.uuid4().hex}"

    class Carrier(WorkerPlugin):
        name = key

        def setup(self, worker: Any) -> None:
            self.task = cloudpickle.loads(payload)

    client.register_plugin(Carrier())
    try:
        yield key
    finally:
        with suppress(Exception):  # a worker that has just started has not got it yet, or the scheduler is gone
            client.unregister_worker_plugin(key)


def _one(name: str, seed: int) -> Result:
    """The row of a seed, or its error; on a worker."""
    task, worker = _task(name), f"{os.uname().nodename}:{os.getpid()}"
    start = time.perf_counter()
    try:
        row, error = row_of(seed, task(seed)), ""
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as raised:  # a panic in Rust is no Exception
        row, error = None, f"{type(raised).__name__}: {raised}"
    return seed, row, error, time.perf_counter() - start, worker


def _task(name: str) -> Task:
    """The task that this worker carries; one that has just started may be given a seed before it."""
    from distributed import get_worker

    worker, end = get_worker(), time.monotonic() + PATIENCE
    while (task := getattr(worker.plugins.get(name), "task", None)) is None:
        if time.monotonic() > end:
            raise RuntimeError(f"{worker.address} was not given the task; its log may say why")
        time.sleep(0.05)
    return task


def _killed(seed: int, died: KilledWorker) -> Result:
    return seed, None, f"KilledWorker: {died}".splitlines()[0], float("nan"), ""


@contextmanager
def _client(client: Client | None, workers: int | None) -> Iterator[Client]:
    if client is not None:
        yield client
        return
    from distributed import Client as Local
    from distributed import LocalCluster

    count = workers or os.cpu_count() or 1
    try:
        # a free port for the dashboard, as another run may have the usual one
        cluster = LocalCluster(n_workers=count, threads_per_worker=1, dashboard_address=":0")
    except RuntimeError as failed:
        raise OrbitcalError(GUARD) from failed
    with cluster, Local(cluster) as local:
        # dask starts no other worker in place of one that dies as it starts; this does, 15 s later
        cluster.adapt(minimum=count, maximum=count)
        yield local
