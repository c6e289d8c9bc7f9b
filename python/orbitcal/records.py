"""What results consist of, with the words of the program's JSON, as dataclasses."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any


def known(kind: type, values: dict[str, Any]) -> dict[str, Any]:
    """Those of the values that are fields of a dataclass; the JSON may grow."""
    names = {one.name for one in fields(kind)}
    return {name: value for name, value in values.items() if name in names}


def each(kind: type, values: list[dict[str, Any]]) -> list[Any]:
    return [kind(**known(kind, one)) for one in values]


@dataclass(frozen=True)
class Var:
    """A strength factor: mean, standard deviation and quantiles of its posterior [1]."""

    name: str
    mean: float
    sigma: float
    q025: float
    q16: float
    q84: float
    q975: float
    clipped: bool = False
    index: int | None = None
    """Row of lattice.csv, of a measured matrix."""


@dataclass(frozen=True)
class Monitor:
    """State of a monitor: `ok`, `noisy`, `jumps` or `dead`; noise of one reading [mm]; readings that were not used."""

    name: str
    state: str
    sigma_mm: float
    rejected: int


@dataclass(frozen=True)
class Finding:
    """An effect that the model lacks; amplitude and sigma in `unit`, evidence in nat."""

    kind: str
    at: str | None
    amplitude: float
    sigma: float
    unit: str
    sentence: str
    s_m: float | None = None
    log_evidence_gain: float | None = None
    probability: float | None = None
    heldout_gain: tuple[float, float] | None = None
    chance: float | None = None
    inseparable: bool = False
    alternatives: list[Finding] = field(default_factory=list)

    @classmethod
    def of_json(cls, values: dict[str, Any]) -> Finding:
        others = [cls.of_json(one) for one in values.get("alternatives", [])]
        return cls(**{**known(cls, values), "alternatives": others})


@dataclass(frozen=True)
class Change:
    """Change of a strength factor from one recording to another, B over A minus 1, and its standard deviation [1]."""

    name: str
    relative: float
    sigma: float
    identifiable: bool
    changed: bool = False
    index: int | None = None
