"""Live estimates: the core in this process, and the shared memory of a daemon. Both give the same `Estimate`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd

from . import _orbitcal
from ._orbitcal import Estimate
from .header import text_of_header
from .recording import Recording, _header
from .ring import Ring

__all__ = ["Correction", "Estimate", "Estimator", "Subscriber"]

ROLES = ("unused", "used", "left out")
Frame = bytes | Mapping[str, Any] | pd.Series


@dataclass(frozen=True)
class Correction:
    """What the feedback made of a frame, by name of the corrector (docs/feedback.md)."""

    setpoint: pd.Series
    """Set points [A]."""
    hold: str | None
    """Why they stay as they were; none where they follow."""
    role: pd.Series
    """`used`, `unused` (others move it) or `left out` (it does not follow)."""
    left_out: int
    """How many are left out."""
    limited: int
    """How many are at their limit."""


class Estimator:
    """The core that runs beside a machine: a frame in, an estimate of all strength factors (vars) out.

    `like` is a recording whose header holds for the frames, or that header as a dictionary (docs/recording.md). `follow` lets vars
    and baselines drift as the daemon does; else `process_noise` is the sigma of ln var per square root of a cycle, and `baseline_walk`
    that of the orbit [um].
    """

    def __init__(
        self,
        ring: Ring,
        like: Recording | Mapping[str, Any],
        *,
        model: Literal["green", "resnet"] = "green",
        follow: bool = False,
        process_noise: float = 0.0,
        baseline_walk: float = 0.0,
    ) -> None:
        self.ring = ring
        self._options = (model, follow, process_noise, baseline_walk)
        self._core: _orbitcal.Core | None = None
        self._feedback: tuple[Any, ...] | None = None
        self._header = None if isinstance(like, Recording) else text_of_header(_header(ring, like))
        if isinstance(like, Recording):
            self._core = _orbitcal.Core(ring._ring, like._recording, *self._options)

    def update(self, frame: Frame) -> Estimate:
        """The estimate after one more frame: wire bytes (docs/frame.md), or the columns of a row of `frames.csv` by name."""
        if isinstance(frame, (bytes, bytearray)):
            return self._ready(None).of_bytes(bytes(frame))
        text = _text_of_frame(frame)
        return self._ready(text).of_text(text)

    def stream(self, frames: Recording | pd.DataFrame | Iterable[Frame]) -> Iterator[Estimate]:
        """One estimate a frame, as the frames come."""
        if isinstance(frames, Recording):
            core = self._ready(None)
            for frame in range(len(frames)):
                yield core.of_recording(frames._recording, frame)
            return
        rows = (row for _, row in frames.iterrows()) if isinstance(frames, pd.DataFrame) else frames
        for row in rows:
            yield self.update(row)

    def steer(
        self,
        orbit: Mapping[str, float] | None = None,
        *,
        correctors: Iterable[str] | None = None,
        limit: float = 20.0,
        rate: float = 2.0,
        probe: float = 1.0,
        close: float = 0.3,
        step_kick: float = 2e-5,
        total_kick: float = 1e-3,
        walk: float = 5e-6,
        patience: float = 2.0,
    ) -> None:
        """Hold the orbit from the next frame on (docs/feedback.md): `correction` has the set points after each frame.

        `orbit`: wanted readings by monitor [m], 0 for those that are not named. `limit`, `rate` (change in one frame), `probe` and `close` in
        A; `step_kick` and `total_kick` in rad; `walk` of the orbit in m/sqrt(s); `patience` between frames in s.
        """
        wanted = dict(orbit or {})
        used = set(self.ring.correctors if correctors is None else correctors)
        for names, known, what in [(wanted, self.ring.monitors, "monitor"), (used, self.ring.correctors, "corrector")]:
            for unknown in sorted(set(names) - set(known)):
                raise _orbitcal.InputError(f"{self.ring.name} has no {what} {unknown!r}")
        self._feedback = (
            [wanted.get(name, 0.0) for name in self.ring.monitors],
            [limit if name in used else 0.0 for name in self.ring.correctors],
            walk,
            step_kick,
            total_kick,
            rate,
            probe,
            close,
            round(patience * 1e6),
        )
        if self._core is not None:
            self._core.steer(*self._feedback)

    @property
    def correction(self) -> Correction | None:
        """What the feedback made of the last frame; none without `steer`, or before a frame."""
        made = None if self._core is None else self._core.correction()
        if made is None:
            return None
        index = pd.Index(self.ring.correctors, name="corrector")
        role = pd.Series([ROLES[code] for code in made["role"]], index, name="role")
        setpoint = pd.Series(made["setpoint"], index, name="setpoint_A", dtype=float)
        return Correction(setpoint, made["hold"], role, made["left_out"], made["limited"])

    @property
    def fitted(self) -> pd.Series:
        """What the posterior expects of the readings of the last frame, by monitor [B] [m]."""
        return pd.Series(self._ready(None).fitted(), pd.Index(self.ring.monitors, name="monitor"), name="fitted_m")

    @property
    def chi2_per_dof(self) -> float:
        """Chi-square of all readings so far per degree of freedom [1]; NaN before there is one."""
        chi2, dof = self._ready(None).fit_quality()
        return chi2 / dof if dof > 0 else float("nan")

    def _ready(self, text: str | None) -> _orbitcal.Core:
        """The core, made for the first frame where there was only a header."""
        if self._core is None:
            if text is None or self._header is None:
                raise _orbitcal.InputError("expected a first frame with the names of its columns: a header does not say which readings wire bytes have")
            like = _orbitcal.Recording.parse("stream", self.ring._ring, self._header, text)
            self._core = _orbitcal.Core(self.ring._ring, like, *self._options)
            if self._feedback is not None:
                self._core.steer(*self._feedback)
        return self._core


class Subscriber:
    """A reader of the estimates that a daemon or a replay publishes in shared memory (docs/shared-memory.md).

    It runs as the publisher's user, in the thread that made it.
    """

    def __init__(self, service: str = "orbitcal/estimate") -> None:
        if not hasattr(_orbitcal, "Subscriber"):
            raise _orbitcal.OrbitcalError("this build of orbitcal reads no shared memory: its feature shared-memory is off")
        self._subscriber = _orbitcal.Subscriber(service)

    def wait(self, timeout: float = 1.0) -> list[Estimate]:
        """All that has arrived, in order; waits up to `timeout` [s] for something."""
        return self._subscriber.wait(timeout)

    def stream(self, timeout: float | None = None) -> Iterator[Estimate]:
        """Estimates as they come; ends after `timeout` [s] without one, if there is a timeout."""
        while True:
            estimates = self.wait(1.0 if timeout is None else timeout)
            if not estimates and timeout is not None:
                return
            yield from estimates

    def __iter__(self) -> Iterator[Estimate]:
        return self.stream()


def frames_as_bytes(recording: Recording) -> Iterator[bytes]:
    """The frames of a recording as they travel on a wire (docs/frame.md)."""
    for frame in range(len(recording)):
        yield bytes(_orbitcal.Core.wire(recording._recording, frame))


def _text_of_frame(frame: Mapping[str, Any] | pd.Series) -> str:
    items = list(frame.items())
    return ",".join(str(name) for name, _ in items) + "\n" + ",".join(_cell(value) for _, value in items) + "\n"


def _cell(value: Any) -> str:
    if pd.isna(value):  # None, NaN and pandas' NA
        return ""
    if isinstance(value, np.generic):
        value = value.item()
    # a table of mixed columns makes floats of whole numbers
    return repr(int(value)) if isinstance(value, float) and value.is_integer() else str(value)
