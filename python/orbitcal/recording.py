"""A recording: frames of a campaign, or a measured response matrix."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Mapping
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import xarray as xr

from . import _orbitcal
from .header import header_of_text, text_of_header
from .ring import Effect, Ring, words

PerInstrument = float | tuple[float, float] | Mapping[str, float] | pd.Series


class Recording:
    """What was measured on a ring: `read`, `from_pandas`, `from_response`; `write` makes the folder that the program reads.

    A recording of frames has `frames` and `header` (docs/recording.md), a measured response matrix has `matrix`
    (docs/real-rings.md).
    """

    def __init__(self, recording: _orbitcal.Recording, ring: Ring) -> None:
        self._recording = recording
        self.ring = ring
        """The ring that it was read for."""

    def __reduce__(self) -> tuple[Any, ...]:
        if self.is_matrix:
            raise _orbitcal.InputError(f"{self.name}: a measured matrix cannot be pickled; write() it")
        return _again, (self.name, self.ring, *self._recording.texts(self.ring._ring))

    @classmethod
    def read(cls, folder: str | PathLike[str], ring: Ring | None = None, *, any_energy: bool = False) -> Recording:
        """Read a folder with `header.toml` and `frames.csv`, or with a measured response matrix.

        Without a ring the frames are those of the built-in Booster that the header names; a matrix has the ring of its own lattice. Frames that were taken at another energy than
        the ring's are refused, but for `any_energy`: `diagnose` takes several of different energies together.
        """
        if (of_frames := ring) is None:
            of_frames = Ring._of(_orbitcal.Ring.built_in(_orbitcal.Recording.lattice(Path(folder))))
        made = _orbitcal.Recording.read(Path(folder), of_frames._ring, any_energy)
        return cls(made, Ring._of(made.ring_of_matrix()) if made.is_matrix and ring is None else of_frames)

    @classmethod
    def from_pandas(
        cls, frames: pd.DataFrame, ring: Ring, header: Mapping[str, Any], *, name: str = "recording"
    ) -> Recording:
        """A recording of format 2 from a table with the columns of `frames.csv`, one row a machine cycle.

        Positions are in mm and currents in A, as the names of the columns say; NaN is an empty cell. `header` has the keys of
        `header.toml`; those that follow from the ring (`machine`, `lattice`, `particle`, `kinetic_energy_GeV`) may be left out.
        """
        text = frames.to_csv(index=False, lineterminator="\n")
        return cls(_orbitcal.Recording.parse(name, ring._ring, text_of_header(_header(ring, header)), text), ring)

    @classmethod
    def from_response(
        cls,
        matrix: pd.DataFrame | xr.DataArray | np.ndarray,
        ring: Ring,
        *,
        orbit_unit: Literal["m", "mm", "um"],
        kick: PerInstrument,
        kick_is: Literal["full", "half"],
        kick_sign: Literal["x+y+", "x-y+", "x+y-", "x-y-"],
        noise: PerInstrument,
        order: Literal["planes", "pairs"] | None = None,
        dispersion: pd.Series | np.ndarray | None = None,
        rf_step: float | None = None,
        rf_frequency: float | None = None,
        name: str = "matrix",
    ) -> Recording:
        """A measured response matrix of a ring that was made of a lattice (`from_pyat`, `from_xsuite`, `from_lattice`).

        Rows are monitors and columns correctors, named as by the ring (`x_BPM.12`) or in the lattice with the plane in front (`x:BPM[3]`), or
        numbers alone with `order`. The model is the ring with its factors. What the numbers mean is asked for, as by `orbitcal import`: `kick` is the deflection [mrad] that an element
        of the matrix belongs to, `noise` its standard deviation in `orbit_unit`; each one number, one a plane, or by name. `dispersion`
        is the change of the orbit when the RF frequency rises by `rf_step` [Hz].
        """
        made = _orbitcal.Recording.assemble(
            ring._ring,
            name,
            _table(matrix),
            order,
            orbit_unit,
            _per_instrument("kick", kick),
            kick_is,
            kick_sign,
            _per_instrument("noise", noise),
            None if dispersion is None else _table(dispersion),
            rf_step,
            rf_frequency,
        )
        return cls(made, ring)

    @classmethod
    def simulated(
        cls,
        template: Recording,
        seed: int,
        *,
        vars: Mapping[str, float] | None = None,
        effects: Iterable[Effect] | Effect = (),
        exact: bool = True,
    ) -> tuple[Recording, pd.Series]:
        """A campaign that a simulated machine would have given, and the vars that it was made with.

        Settings, read-backs and gaps are those of the template. Without `vars` they are drawn from the ring's prior, of rings with stable motion. `exact`:
        every frame an exact orbit of misaligned magnets with `effects`, monitors with offsets, noise and jumps, tunes; else the machine of
        the estimator's model. The seed fixes everything.
        """
        named = None if vars is None else {str(name): float(value) for name, value in vars.items()}
        ring = template.ring
        made, drawn = _orbitcal.simulate(ring._ring, template._recording, seed, named, words(effects), exact)
        return cls(made, ring), pd.Series(drawn, pd.Index(ring._ring.vars, name="var"), name="factor")

    @property
    def name(self) -> str:
        """Name of the folder, or that which was given."""
        return self._recording.name

    @property
    def is_matrix(self) -> bool:
        """True of a measured response matrix."""
        return self._recording.is_matrix

    @property
    def frames(self) -> pd.DataFrame:
        """The frames with the columns of `frames.csv`, in format 2; a reading that is missing is NaN.

        `setting_A` is a number, or a text such as `22;-22` in all rows where a frame has several correctors.
        """
        text = self._recording.texts(self.ring._ring)[1]
        frames = pd.read_csv(io.StringIO(text), dtype={"corrector": str, "setting_A": str}, keep_default_na=True)
        if not frames["setting_A"].str.contains(";", na=False).any():
            frames["setting_A"] = pd.to_numeric(frames["setting_A"])
        return frames

    @property
    def header(self) -> dict[str, Any]:
        """The header with the keys of `header.toml`, in format 2."""
        return header_of_text(self._recording.texts(self.ring._ring)[0])

    @property
    def matrix(self) -> xr.DataArray:
        """Orbit at plus half the kick less that at minus half, dimensions `monitor` and `corrector` [mm]; NaN was not measured.

        Coordinates: `kick` of each corrector [mrad], `noise` of an element in each monitor's row [mm].
        """
        monitors, correctors, values, kick, noise = self._recording.matrix()
        coords = {
            "monitor": monitors,
            "corrector": correctors,
            "kick": ("corrector", kick, {"units": "mrad"}),
            "noise": ("monitor", noise, {"units": "mm"}),
        }
        return xr.DataArray(values, coords, ("monitor", "corrector"), "response_matrix", {"units": "mm"})

    def check(self) -> dict[str, Any]:
        """What it holds and what can be done with it: the JSON of `orbitcal check`.

        Of a matrix: how many elements, and `agreement` of each plane with the lattice's own, factor and correlation near 1 where units and
        signs are right.
        """
        return json.loads(self._recording.check(self.ring._ring))

    def write(self, folder: str | PathLike[str]) -> Path:
        """Write the folder that the program reads, and return its path. The folder of a matrix must not be there yet."""
        self._recording.write(Path(folder), self.ring._ring)
        return Path(folder)

    def __len__(self) -> int:
        """Number of frames; 0 of a matrix."""
        return self._recording.frames()

    def __bool__(self) -> bool:
        """True, though a matrix has no frames."""
        return True

    def __repr__(self) -> str:
        what = "a response matrix" if self.is_matrix else f"{len(self)} frames"
        return f"<orbitcal.Recording {self.name!r}: {what} of {self.ring.name!r}>"


def _again(name: str, ring: Ring, header: str, frames: str) -> Recording:
    return Recording(_orbitcal.Recording.again(name, ring._ring, header, frames), ring)


def _header(ring: Ring, header: Mapping[str, Any]) -> dict[str, Any]:
    of_ring = {
        "format": 2,
        "machine": ring.name,
        "lattice": ring._ring.file,
        "particle": ring.particle,
        "kinetic_energy_GeV": ring.kinetic_energy,
    }
    return {**of_ring, **header}


def _table(values: Any) -> str:
    if isinstance(values, xr.DataArray):
        values = values.to_pandas()
    if isinstance(values, (pd.DataFrame, pd.Series)):
        named = values.to_frame("value") if isinstance(values, pd.Series) else values
        return named.to_csv(lineterminator="\n")
    numbers = np.atleast_2d(np.asarray(values, dtype=float))
    numbers = numbers.T if np.ndim(values) == 1 else numbers
    return "".join(",".join("" if np.isnan(one) else repr(float(one)) for one in row) + "\n" for row in numbers)


def _per_instrument(what: str, value: PerInstrument) -> str:
    try:
        return _text_per_instrument(value)
    except (TypeError, ValueError, IndexError):
        raise _orbitcal.InputError(f"{what}: expected a number, two (x, y), or numbers by name, found {value!r}") from None


def _text_per_instrument(value: PerInstrument) -> str:
    if isinstance(value, (Mapping, pd.Series)):
        return "".join(f"{name},{float(one)!r}\n" for name, one in value.items())
    if isinstance(value, (tuple, list)):
        x, y = value
        return f"x={float(x)!r},y={float(y)!r}"
    return repr(float(value))
