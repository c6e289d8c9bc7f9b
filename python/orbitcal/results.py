"""Results with the words of the program's JSON (docs and `orbitcal COMMAND --json`), as dataclasses.

Every result keeps the whole JSON (`json`, `to_json`), prints as the program does (`str`), shows as a table and a figure in a
notebook, and writes the program's page (`report`).
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, fields
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from . import figures
from .records import Change, Finding, Monitor, Var, each, known

if TYPE_CHECKING:
    from .figures import Drawn


@dataclass(frozen=True, repr=False)
class _Result:
    _outcome: Any

    @property
    def json(self) -> dict[str, Any]:
        """The JSON as a dictionary."""
        return json.loads(self._outcome.json)

    def to_json(self) -> str:
        """The JSON as text, as the program's `--json` writes it."""
        return self._outcome.json

    def save(self, path: str | PathLike[str]) -> Path:
        """Write the JSON, for `orbitcal export` and others."""
        Path(path).write_text(self._outcome.json + "\n", encoding="utf-8")
        return Path(path)

    def report(self, path: str | PathLike[str]) -> Path:
        """Write the program's page, one HTML file with all figures and their numbers, and return its path."""
        self._outcome.report(Path(path))
        return Path(path)

    def __str__(self) -> str:
        return self._outcome.text

    def __repr__(self) -> str:
        return self._outcome.text

    def _repr_html_(self) -> str:
        return figures.html(self)

    def figure(self) -> Drawn:
        """The main figure, by matplotlib."""
        raise NotImplementedError


@dataclass(frozen=True, repr=False)
class FitResult(_Result):
    """Vars with error bars, and how well they describe a recording or a measured matrix."""

    recording: str
    method: str
    model: str
    vars: list[Var]
    monitors: list[Monitor]
    chi2_per_dof: float | None = None
    tunes: tuple[float, float] | None = None
    tunes_measured: dict[str, Any] | None = None
    mismatch: bool = False
    lack: str | None = None
    frames: int | None = None
    nuts: dict[str, Any] | None = None
    other: list[dict[str, Any]] = field(default_factory=list)
    """Gains and couplings of instruments, of a measured matrix."""
    imperfections: list[dict[str, Any]] = field(default_factory=list)
    """What the design is off by throughout the ring, of a recording."""
    wiring: list[dict[str, str]] = field(default_factory=list)
    degenerate: list[list[str]] = field(default_factory=list)

    @classmethod
    def of(cls, outcome: Any) -> FitResult:
        """From what the work came to."""
        values = json.loads(outcome.json)
        changed = {
            "vars": each(Var, values["vars"]),
            "monitors": each(Monitor, values["monitors"]),
            "tunes": _tunes(values.get("tunes")),
        }
        return cls(outcome, **{**known(cls, values), **changed})

    @property
    def means(self) -> pd.Series:
        """Mean of each var, by name [1]."""
        return pd.Series([one.mean for one in self.vars], index=pd.Index([v.name for v in self.vars], name="var"))

    @property
    def table(self) -> pd.DataFrame:
        """The vars as a table: mean, sigma and quantiles [1]."""
        return _table(self.vars)

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the vars [N][N] [1]."""
        return np.array(self.json["covariance"])

    def figure(self) -> Drawn:
        """The vars with their 68 % and 95 % intervals."""
        return figures.of_vars({"fit": self.vars}, self.recording)


@dataclass(frozen=True, repr=False)
class DiagnosisResult(_Result):
    """What the model of a recording lacks: `consistent`, `identified`, `ambiguous` or `unexplained`."""

    recording: str
    verdict: str
    sentence: str
    findings: list[Finding]
    monitors: list[Monitor] = field(default_factory=list)
    fit: dict[str, Any] = field(default_factory=dict)
    vars_before: list[Var] = field(default_factory=list)
    vars_after: list[Var] = field(default_factory=list)
    beyond_range: list[dict[str, Any]] = field(default_factory=list)
    tunes: tuple[float, float] | None = None
    tunes_measured: dict[str, Any] | None = None
    joint_probability: float | None = None
    next_measurement: str | None = None
    probabilities: dict[str, float] = field(default_factory=dict)
    imperfections: list[dict[str, Any]] = field(default_factory=list)
    unexplained: list[dict[str, Any]] = field(default_factory=list)

    @classmethod
    def of(cls, outcome: Any) -> DiagnosisResult:
        """From what the work came to."""
        values = json.loads(outcome.json)
        changed = {
            "findings": [Finding.of_json(one) for one in values["findings"]],
            "monitors": each(Monitor, values.get("monitors", [])),
            "vars_before": each(Var, values.get("vars_before", [])),
            "vars_after": each(Var, values.get("vars_after", [])),
            "tunes": _tunes(values.get("tunes")),
        }
        return cls(outcome, **{**known(cls, values), **changed})

    @property
    def means(self) -> pd.Series:
        """Mean of each var with what was found in the model, by name [1]."""
        names = pd.Index([one.name for one in self.vars_after], name="var")
        return pd.Series([one.mean for one in self.vars_after], index=names)

    @property
    def table(self) -> pd.DataFrame:
        """Findings and, below each, its alternatives."""
        rows = [(one, "") for one in self.findings]
        rows = [row for one, word in rows for row in [(one, word), *((other, "or") for other in one.alternatives)]]
        columns = ["kind", "at", "s_m", "amplitude", "sigma", "unit", "log_evidence_gain", "probability"]
        return pd.DataFrame(
            [["" if word == "" else word, *(getattr(one, c) for c in columns)] for one, word in rows],
            columns=["", *columns],
        )

    def figure(self) -> Drawn:
        """Probabilities of what was found and of its alternatives, and the vars without and with it."""
        fits = {"without": self.vars_before, "with what was found": self.vars_after}
        fits = {name: vars for name, vars in fits.items() if vars}
        return figures.of_findings(self.findings, fits, f"{self.recording}: {self.verdict}")


@dataclass(frozen=True, repr=False)
class Comparison(_Result):
    """What changed between two recordings, or two measured matrices."""

    changes: list[Change]
    sentence: str
    others: list[dict[str, Any]] = field(default_factory=list)

    @classmethod
    def of(cls, outcome: Any) -> Comparison:
        """From what the work came to."""
        values = json.loads(outcome.json)
        return cls(outcome, **{**known(cls, values), "changes": each(Change, values["changes"])})

    @property
    def table(self) -> pd.DataFrame:
        """The changes as a table [1]."""
        return _table(self.changes)

    def figure(self) -> Drawn:
        """The changes with their 68 % error bars."""
        return figures.of_changes(self.changes)


def _table(rows: list[Any]) -> pd.DataFrame:
    names = [one.name for one in fields(rows[0])] if rows else ["name"]
    table = pd.DataFrame([[getattr(row, name) for name in names] for row in rows], columns=names)
    return table.set_index("name").dropna(axis="columns", how="all")


def _tunes(values: dict[str, float] | None) -> tuple[float, float] | None:
    return None if values is None else (values["x"], values["y"])
