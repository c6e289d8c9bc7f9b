"""The folder of an ensemble: rows, costs and failures as Parquet, and whose results they are."""

from __future__ import annotations

import functools
import json
import os
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import pandas as pd

from .._orbitcal import InputError

if TYPE_CHECKING:
    import pyarrow as pa

Task = Callable[[int], Mapping[str, Any]]
Result: TypeAlias = "tuple[int, pa.Table | None, str, float, str]"  # seed, row, error, seconds, worker

ROWS = 200  # of a part at most
SECONDS = 10.0  # after which what has come is written, if it is less
FOLDERS = ("rows", "costs", "failures")


class Store:
    """Rows, costs and failures of one task in a folder."""

    def __init__(self, folder: Path, task: Task) -> None:
        self.folder = folder
        self._rows: list[pa.Table] = []
        self._costs: list[dict[str, Any]] = []
        self._failures: list[dict[str, Any]] = []
        self._written = time.monotonic()
        for name in FOLDERS:
            (folder / name).mkdir(parents=True, exist_ok=True)
        says, path = _says(task), folder / "task.json"
        if not path.exists():
            _write(path, lambda to: to.write_text(json.dumps(says, indent=2) + "\n"))
        # as texts, as NaN is not equal to itself
        elif json.dumps(found := json.loads(path.read_text()), sort_keys=True) != json.dumps(says, sort_keys=True):
            raise InputError(f"{folder}: expected results of {says}, found those of {found}")

    def take(self, seed: int, row: pa.Table | None, error: str, seconds: float, worker: str) -> None:
        """One more result: a table of one row (`row_of`), or none and why."""
        if row is None:
            self._failures.append({"seed": seed, "error": error})
        else:
            self._rows.append(row)
            self._costs.append({"seed": seed, "seconds": seconds, "worker": worker})
        if len(self._rows) >= ROWS or time.monotonic() - self._written > SECONDS:
            self.flush()

    def flush(self) -> None:
        """Write what has come; a part appears whole or not at all, rows last, so that each has its cost."""
        import pyarrow as pa

        for name, held in (("failures", self._failures), ("costs", self._costs)):
            if held:
                self._part(name, pa.Table.from_pylist(held))
                held.clear()
        for table in _agreeing(self._rows):
            self._part("rows", table)
        self._rows.clear()
        self._written = time.monotonic()

    def _part(self, name: str, table: pa.Table) -> None:
        from pyarrow import parquet

        _write(self.folder / name / f"{uuid.uuid4().hex}.parquet", lambda to: parquet.write_table(table, to))

    def seeds(self) -> set[int]:
        """Seeds that need not be run: those with a row, and those that were set aside."""
        folders = (self.folder / "rows", self.folder / "failures")
        return {seed for folder in folders for part in _parts(folder, ["seed"]) for seed in part["seed"].to_pylist()}


def table_of(folder: Path) -> pd.DataFrame:
    """All rows of a folder of parts, in the order of the seeds; it does not depend on how rows fell into parts."""
    import pyarrow.compute as pc

    # so that columns are in the order in which the seeds bring them
    parts = sorted(_parts(folder), key=lambda part: pc.min(part["seed"]).as_py())
    names = dict.fromkeys(name for part in parts for name in part.column_names)
    table = pd.DataFrame({name: _column(parts, name) for name in names})
    if table.empty:
        return table
    # a run that was killed between two parts has some twice, the same
    return table.drop_duplicates("seed").sort_values("seed").reset_index(drop=True)


def row_of(seed: int, row: Mapping[str, Any]) -> pa.Table:
    """The row of a seed as a table that Parquet can hold; raises what says why it cannot."""
    import pyarrow as pa
    from pyarrow import parquet

    if not isinstance(row, Mapping):
        raise TypeError(f"expected a row as a dictionary, found {type(row).__name__}")
    if "seed" in row:
        raise ValueError("a row has no column seed of its own: it is that of the run")
    table = pa.Table.from_pylist([{"seed": seed, **row}])
    # Arrow holds more types than Parquet does
    parquet.write_table(table, pa.BufferOutputStream())
    return table


def _says(task: Task) -> dict[str, Any]:
    """Whose results these are: module and name of the task, and what else it says of itself; as JSON gives it back."""
    says: dict[str, Any] = {}
    if isinstance(task, functools.partial):
        says = {"arguments": repr((task.args, task.keywords))}
        task = task.func
    named = task if hasattr(task, "__qualname__") else type(task)
    says = {"task": f"{named.__module__}.{named.__qualname__}", **says, **getattr(task, "says", {})}
    return json.loads(json.dumps(says))


def _write(path: Path, write: Callable[[Path], Any]) -> None:
    """A file that appears whole or not at all."""
    partial = path.with_suffix(".partial")
    write(partial)
    os.replace(partial, path)


def _agreeing(rows: Iterable[pa.Table]) -> Iterator[pa.Table]:
    """Rows of the same columns and of types that agree as one table each; a type that is not known yet agrees with all."""
    import pyarrow as pa

    groups: list[tuple[pa.Schema, list[pa.Table]]] = []
    for row in rows:
        for place, (schema, group) in enumerate(groups):
            if (joined := _joined(schema, row.schema)) is not None:
                groups[place] = joined, [*group, row]
                break
        else:
            groups.append((row.schema, [row]))
    for _, group in groups:
        yield pa.concat_tables(group, promote_options="default").combine_chunks()


def _joined(one: pa.Schema, other: pa.Schema) -> pa.Schema | None:
    import pyarrow as pa

    if one.equals(other):
        return one
    if one.names != other.names:
        return None
    try:
        return pa.unify_schemas([one, other], promote_options="default")
    except (pa.ArrowTypeError, pa.ArrowInvalid):
        return None


def _parts(folder: Path, columns: list[str] | None = None) -> Iterator[pa.Table]:
    from pyarrow import parquet

    for path in sorted(folder.glob("*.parquet")):
        with parquet.ParquetFile(path) as file:  # `read_table` would take `x=1` in the path for a column
            yield file.read(columns=columns).replace_schema_metadata(None)


def _column(parts: list[pa.Table], name: str) -> pd.Series:
    """A column of all parts; as Python's own values where they are of several types."""
    import pyarrow as pa

    pieces = [part.select([name]) if name in part.column_names else _nulls(name, len(part)) for part in parts]
    try:
        return pa.concat_tables(pieces, promote_options="permissive")[name].to_pandas()
    except (pa.ArrowTypeError, pa.ArrowInvalid):
        return pd.Series([value for piece in pieces for value in piece[name].to_pylist()], name=name, dtype=object)


def _nulls(name: str, count: int) -> pa.Table:
    import pyarrow as pa

    return pa.table({name: pa.nulls(count)})
