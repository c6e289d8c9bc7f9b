"""A ring: response, Jacobian and optics of its twin as labelled arrays, and the way to and from other codes."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from itertools import count
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import pandas as pd
import xarray as xr

from . import _orbitcal, codes
from .labels import Labels

if TYPE_CHECKING:
    import at
    import xtrack

    from .records import Finding
    from .results import DiagnosisResult, FitResult

Effect: TypeAlias = "str | Finding | Mapping[str, Any]"
Patterns: TypeAlias = "str | Iterable[str]"
Rf = Literal["fixed-momentum", "fixed-frequency"]
Format = Literal["madx", "bmad", "at", "xsuite", "pals"]


class Ring:
    """A ring and its digital twin.

    `Ring(path)` reads a machine file (docs/machine.md); the others are made by `booster`, `from_pyat`, `from_xsuite` and
    `from_lattice`. A ring does not change: `with_vars` and `with_priors` give new ones.

    Units are SI: m, rad, 1/m^2. An effect is a text `KIND[@PLACE][=AMPLITUDE]` such as `"quad_roll@D8=0.01"`, in the words of
    `orbitcal response --effect`, or a finding of a diagnosis.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        path = Path(path)
        try:
            text = path.read_text(encoding="utf-8")
        except FileNotFoundError:
            raise _orbitcal.InputError(f"{path}: file not found") from None
        self._take(_orbitcal.Ring.machine(text, str(path)))

    def _take(self, ring: _orbitcal.Ring) -> None:
        self._ring = ring
        self._labels: Labels | None = None

    @classmethod
    def _of(cls, ring: _orbitcal.Ring) -> Ring:
        self = cls.__new__(cls)
        self._take(ring)
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return _again, (self._ring.state(),)

    @classmethod
    def booster(cls) -> Ring:
        """The built-in AGS Booster: 48 quadrupoles, 33 monitors that are read, 48 correctors."""
        return cls._of(_orbitcal.Ring.built_in())

    @classmethod
    def from_pyat(cls, lattice: at.Lattice, *, monitors: Patterns = (), correctors: Patterns = ()) -> Ring:
        """The ring of a pyAT lattice in memory.

        Monitors and correctors are elements of the classes `Monitor` and `Corrector`, or those whose names match the patterns:
        `monitors="BPM*"`, `correctors=["x:CH*", "y:CV*"]`. What the twin leaves out is said in a warning.
        """
        return cls._of_lattice(codes.text_of_pyat(lattice), codes.name_of(lattice), monitors, correctors)

    @classmethod
    def from_xsuite(cls, line: xtrack.Line, *, monitors: Patterns = (), correctors: Patterns = ()) -> Ring:
        """The ring of an Xsuite line in memory, before slicing; patterns as in `from_pyat`."""
        return cls._of_lattice(codes.text_of_xsuite(line), codes.name_of(line), monitors, correctors)

    @classmethod
    def from_lattice(
        cls, path: str | PathLike[str], *, monitors: Patterns = (), correctors: Patterns = ()
    ) -> Ring:
        """The ring of a lattice file of text: JSON by pyAT or Xsuite, a table by MAD-X, or PALS (docs/your-own-ring.md)."""
        path = Path(path)
        try:
            text = path.read_text(encoding="utf-8")
        except FileNotFoundError:
            raise _orbitcal.InputError(f"{path}: file not found") from None
        return cls._of_lattice(text, str(path), monitors, correctors)

    @classmethod
    def _of_lattice(cls, text: str, name: str, monitors: Patterns, correctors: Patterns) -> Ring:
        # a text is one pattern, not a list of letters
        listed = ([one] if isinstance(one, str) else list(one) for one in (monitors, correctors))
        ring = cls._of(_orbitcal.Ring.lattice(text, name, *listed))
        for what, elements in ring._ring.left_out:
            warnings.warn(f"{name}: left out of {elements} elements: {what}", stacklevel=3)
        return ring

    @property
    def name(self) -> str:
        """Name of the machine."""
        return self._ring.name

    @property
    def circumference(self) -> float:
        """Length of the reference orbit [m]."""
        return self._ring.circumference

    @property
    def particle(self) -> str:
        """`proton` or `electron`."""
        return self._ring.particle

    @property
    def kinetic_energy(self) -> float:
        """Kinetic energy [GeV]."""
        return self._ring.kinetic_energy

    @property
    def vars(self) -> pd.Series:
        """Strength factors on the gradients of the file, by name [N] [1]."""
        return pd.Series(self._ring.factors, index=pd.Index(self._ring.vars, name="var"), name="factor")

    @property
    def quadrupoles(self) -> pd.Series:
        """Gradients, by name [M] [1/m^2]."""
        return pd.Series(self._ring.gradients, index=pd.Index(self._ring.quadrupoles, name="quadrupole"), name="k1")

    @property
    def monitors(self) -> list[str]:
        """Names of the monitors that are read, with their plane: `x_D8` [B]."""
        return self._ring.monitors

    @property
    def correctors(self) -> list[str]:
        """Names of the correctors, with their plane: `H_A4` [C]."""
        return self._ring.correctors

    @property
    def supplies(self) -> list[str]:
        """Names of the main supplies of quadrupoles [F]."""
        return self._ring.supplies

    def with_vars(self, vars: Mapping[str, float] | pd.Series | FitResult) -> Ring:
        """The same ring with factors on its gradients, 1 for those that are not named. Of a fit, the factors are its means."""
        if hasattr(vars, "means"):
            vars = vars.means
        return Ring._of(self._ring.with_vars({str(name): float(value) for name, value in vars.items()}))

    def with_priors(self, *, width: float | None = None, range: tuple[float, float] | None = None) -> Ring:
        """The same ring with another prior width or range of its vars, for `fit`, `sample`, `diagnose` and `Estimator`."""
        return Ring._of(self._ring.with_priors(width, range))

    def response(
        self, *, effects: Iterable[Effect] | Effect = (), rf: Rf = "fixed-momentum", all_places: bool = False
    ) -> xr.DataArray:
        """Closed-orbit response to small kicks [m/rad].

        Dimensions `monitor` [B] and `corrector` [C]: what each monitor that is read sees in its own plane; coordinates `s_monitor`
        and `s_corrector` [m]. With `all_places` there is `plane` (x, y) in front, and `monitor` counts all monitors of the ring, read or not, as
        in the JSON of `orbitcal response`.
        """
        if all_places:
            values = self._ring.full_response(words(effects), rf)
            coords = {"plane": ["x", "y"], "monitor": self._ring.places, "corrector": self.correctors}
            return xr.DataArray(values, coords, ("plane", "monitor", "corrector"), "response", _of_response("m/rad"))
        values = self._ring.response(words(effects), rf)
        if self._labels is None:
            self._labels = Labels(xr.DataArray(values, self._coords(), ("monitor", "corrector")))
        return self._labels.on(values, "response", _of_response("m/rad"))

    def _coords(self) -> dict[str, Any]:
        of_monitors, of_correctors = self._ring.positions
        unit = {"units": "m"}
        return {
            "monitor": self.monitors,
            "corrector": self.correctors,
            "s_monitor": ("monitor", of_monitors, unit),
            "s_corrector": ("corrector", of_correctors, unit),
        }

    def jacobian(
        self,
        *,
        by: Literal["var", "quadrupole"] = "var",
        effects: Iterable[Effect] | Effect = (),
        rf: Rf = "fixed-momentum",
    ) -> xr.DataArray:
        """Exact derivative of `response`, with dimensions (`by`, `monitor`, `corrector`).

        `by="var"`: with respect to `ln` of each strength factor [N][B][C] [m/rad], so that a factor of 1.01 adds 0.01 of it to
        first order. `by="quadrupole"`: with respect to each gradient [M][B][C] [m/rad per 1/m^2].
        """
        if by not in ("var", "quadrupole"):
            raise _orbitcal.InputError(f"by: expected var or quadrupole, found {by!r}")
        is_of_gradients = by == "quadrupole"
        values = self._ring.jacobian(is_of_gradients, words(effects), rf)
        names = self._ring.quadrupoles if is_of_gradients else self._ring.vars
        unit = "m/rad/(1/m^2)" if is_of_gradients else "m/rad"
        coords = {by: names, **self._coords()}
        return xr.DataArray(values, coords, (by, "monitor", "corrector"), "response_jacobian", _of_response(unit))

    def optics(self, *, effects: Effect | Iterable[Effect] = (), rf: Rf = "fixed-momentum") -> xr.Dataset:
        """Linear optics at the entrance of every element and at the end of the ring, at the momentum that `rf` leaves.

        `beta` [m], `phase_advance` [rad], `dispersion` [m] and `orbit` [m] with dimensions `plane` (x, y) and `element` [E + 1];
        coordinate `s` [m]. Attributes: `tune_x`, `tune_y`, `momentum_compaction`, `gamma_transition` [1].
        """
        made = self._ring.optics(words(effects), rf)
        names, starts = self._ring.elements
        planes = ("plane", "element")
        of = lambda name, unit: (planes, made[name].reshape(2, -1), {"units": unit})
        return xr.Dataset(
            {
                "beta": of("beta", "m"),
                "phase_advance": of("phase_advance", "rad"),
                "dispersion": of("dispersion", "m"),
                "orbit": of("orbit", "m"),
            },
            coords={
                "plane": ["x", "y"],
                "element": [*_named(names), "end"],
                "s": ("element", [*starts, self.circumference], {"units": "m"}),
            },
            attrs={
                "machine": self.name,
                "tune_x": made["tunes"][0],
                "tune_y": made["tunes"][1],
                "momentum_compaction": made["momentum_compaction"],
                "gamma_transition": made["gamma_transition"],
            },
        )

    def to_pyat(self, result: FitResult | DiagnosisResult | None = None) -> at.Lattice:
        """The ring as a pyAT lattice, with the strengths and the certain findings of a result if there is one."""
        return codes.pyat_of_text(self.export("at", result=result))

    def to_xsuite(self, result: FitResult | DiagnosisResult | None = None) -> xtrack.Line:
        """The same as an Xsuite line, with a knob `kick_NAME` for each corrector."""
        return codes.xsuite_of_text(self.export("xsuite", result=result))

    def export(
        self,
        format: Format,
        path: str | PathLike[str] | None = None,
        *,
        result: FitResult | DiagnosisResult | None = None,
    ) -> str:
        """The text of a lattice file (docs/export.md), written to `path` if there is one."""
        text = self._ring.export(format, None if result is None else result.to_json())
        if path is not None:
            Path(path).write_text(text, encoding="utf-8")
        return text

    def __repr__(self) -> str:
        return (
            f"<orbitcal.Ring {self.name!r}: {self.circumference:.2f} m, {len(self._ring.quadrupoles)} quadrupoles,"
            f" {len(self.monitors)} monitors, {len(self.correctors)} correctors>"
        )


def _again(state: Any) -> Ring:
    return Ring._of(_orbitcal.Ring.again(state))


def _named(elements: Iterable[str]) -> list[str]:
    """Names of elements; drifts are counted, as in exported lattices."""
    drifts = count(1)
    return [name or f"drift_{next(drifts)}" for name in elements]


def words(effects: Iterable[Effect] | Effect) -> list[str]:
    """Effects, or one alone, as texts; findings, and dictionaries as of the JSON, have `kind`, `at` and `amplitude`."""
    if isinstance(effects, (str, Mapping)) or not isinstance(effects, Iterable):
        effects = [effects]
    return [effect if isinstance(effect, str) else _word(effect) for effect in effects]


def _word(effect: Finding | Mapping[str, Any]) -> str:
    of = effect.get if isinstance(effect, Mapping) else lambda name: getattr(effect, name)
    at, amplitude = of("at"), of("amplitude")
    return f"{of('kind')}{f'@{at}' if at else ''}{'' if amplitude is None else f'={float(amplitude)!r}'}"


def _of_response(unit: str) -> dict[str, str]:
    return {"units": unit, "long_name": "orbit response"}
