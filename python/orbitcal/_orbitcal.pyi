"""The Rust layer; the modules beside it are what one uses, but for `Estimate` and the errors."""

from collections.abc import Callable
from os import PathLike
from typing import Any, final

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

__all__ = [
    "Core",
    "Estimate",
    "InputError",
    "OrbitcalError",
    "Outcome",
    "Recording",
    "Ring",
    "Subscriber",
    "Validation",
    "__version__",
    "compare",
    "diagnose",
    "fit",
    "marginals",
    "sample",
    "simulate",
]

__version__: str

_Hear = Callable[[str, int], None] | None
_Reals = NDArray[np.float64]
_Singles = NDArray[np.float32]

class InputError(ValueError):
    """An input is wrong: where, what was expected and what was found."""

class OrbitcalError(RuntimeError):
    """Anything else that went wrong."""

@final
class Ring:
    @staticmethod
    def built_in(file: str | None = None) -> Ring: ...
    @staticmethod
    def machine(text: str, file: str) -> Ring: ...
    @staticmethod
    def lattice(text: str, file: str, monitors: list[str], correctors: list[str]) -> Ring: ...
    @staticmethod
    def again(state: Any) -> Ring: ...
    def state(self) -> Any: ...
    def with_vars(self, vars: dict[str, float]) -> Ring: ...
    def with_priors(self, width: float | None, range: tuple[float, float] | None) -> Ring: ...
    @property
    def name(self) -> str: ...
    @property
    def file(self) -> str: ...
    @property
    def circumference(self) -> float: ...
    @property
    def particle(self) -> str: ...
    @property
    def kinetic_energy(self) -> float: ...
    @property
    def vars(self) -> list[str]: ...
    @property
    def factors(self) -> list[float]: ...
    @property
    def monitors(self) -> list[str]: ...
    @property
    def places(self) -> list[str]: ...
    @property
    def correctors(self) -> list[str]: ...
    @property
    def quadrupoles(self) -> list[str]: ...
    @property
    def gradients(self) -> list[float]: ...
    @property
    def priors(self) -> list[list[float]]: ...
    @property
    def supplies(self) -> list[str]: ...
    @property
    def elements(self) -> tuple[list[str], list[float]]: ...
    @property
    def positions(self) -> tuple[list[float], list[float]]: ...
    @property
    def left_out(self) -> list[tuple[str, int]]: ...
    def response(self, effects: list[str], rf: str) -> _Reals: ...
    def full_response(self, effects: list[str], rf: str) -> _Reals: ...
    def jacobian(self, by_gradient: bool, effects: list[str], rf: str) -> _Reals: ...
    def optics(self, effects: list[str], rf: str) -> dict[str, Any]: ...
    def export(self, format: str, result: str | None) -> str: ...

@final
class Recording:
    @staticmethod
    def read(folder: str | PathLike[str], ring: Ring, any_energy: bool) -> Recording: ...
    @staticmethod
    def lattice(folder: str | PathLike[str]) -> str | None: ...
    @staticmethod
    def parse(name: str, ring: Ring, header: str, frames: str) -> Recording: ...
    @staticmethod
    def again(name: str, ring: Ring, header: str, frames: str) -> Recording: ...
    def ring_of_matrix(self) -> Ring: ...
    @staticmethod
    def assemble(
        ring: Ring,
        name: str,
        table: str,
        order: str | None,
        orbit_unit: str,
        kick: str,
        kick_is: str,
        kick_sign: str,
        noise: str,
        dispersion: str | None,
        rf_step: float | None,
        rf_frequency: float | None,
    ) -> Recording: ...
    @property
    def name(self) -> str: ...
    @property
    def is_matrix(self) -> bool: ...
    def texts(self, ring: Ring) -> list[str]: ...
    def frames(self) -> int: ...
    def matrix(self) -> tuple[list[str], list[str], _Reals, list[float], list[float]]: ...
    def write(self, folder: str | PathLike[str], ring: Ring) -> None: ...
    def check(self, ring: Ring) -> str: ...

@final
class Outcome:
    @property
    def json(self) -> str: ...
    @property
    def text(self) -> str: ...
    def report(self, path: str | PathLike[str]) -> None: ...

def fit(ring: Ring, recording: Recording, rf: str | None, exact_design: bool, hear: _Hear) -> Outcome: ...
def sample(
    ring: Ring,
    recording: Recording,
    model: str,
    chains: int,
    warm_up: int,
    draws: int,
    seed: int,
    exact_design: bool,
    hear: _Hear,
) -> tuple[Outcome, dict[str, Any]]: ...
def diagnose(ring: Ring, recordings: list[Recording], rf: str | None, hear: _Hear) -> Outcome: ...
def compare(ring: Ring, before: Recording, after: Recording, hear: _Hear) -> Outcome: ...
def simulate(
    ring: Ring, template: Recording, seed: int, vars: dict[str, float] | None, effects: list[str], exact: bool
) -> tuple[Recording, list[float]]: ...
def marginals(ring: Ring, recording: Recording) -> tuple[list[float], list[float]]: ...

@final
class Validation:
    def __new__(cls, ring: Ring, template: Recording) -> Self: ...
    def run(self, kind: str, index: int, seed: int) -> str | None: ...

@final
class Core:
    def __new__(
        cls, ring: Ring, like: Recording, model: str, follow: bool, process_noise: float, baseline_walk: float
    ) -> Self: ...
    def of_bytes(self, frame: bytes) -> Estimate: ...
    def of_recording(self, recording: Recording, frame: int) -> Estimate: ...
    def of_text(self, frames: str) -> Estimate: ...
    @staticmethod
    def wire(recording: Recording, frame: int) -> bytes: ...
    def fit_quality(self) -> list[float]: ...
    def fitted(self) -> _Singles: ...
    def steer(
        self,
        orbit: list[float],
        limit: list[float],
        walk: float,
        step_kick: float,
        total_kick: float,
        rate: float,
        probe: float,
        close: float,
        patience_us: int,
    ) -> None: ...
    def correction(self) -> dict[str, Any] | None: ...

@final
class Subscriber:
    def __new__(cls, service: str) -> Self: ...
    def wait(self, timeout: float) -> list[Estimate]: ...

@final
class Estimate:
    """Vars with error bars and covariance, and the state of every monitor, after one frame; what docs/shared-memory.md has."""

    @property
    def machine(self) -> str: ...
    @property
    def publisher(self) -> str | None:
        """Name of the publisher; none of an `Estimator` in this process."""
    @property
    def vars(self) -> list[str]: ...
    @property
    def monitors(self) -> list[str]: ...
    @property
    def sequence(self) -> int:
        """Sequence number of the frame."""
    @property
    def time_us(self) -> int:
        """Time of the frame [us]."""
    @property
    def frames(self) -> int:
        """Frames taken so far, those put aside included."""
    @property
    def rejected_frames(self) -> int: ...
    @property
    def linearised(self) -> bool:
        """The model was relinearised since the last estimate."""
    @property
    def mismatch(self) -> bool | None:
        """The readings are further off than noise explains; none where that was not asked."""
    @property
    def nis(self) -> float:
        """Normalised innovation squared of the readings used, summed [1]."""
    @property
    def log_evidence(self) -> float:
        """`ln` of the evidence of all readings [nat]."""
    @property
    def tune_innovation(self) -> list[float | None]:
        """Measured less predicted tunes x and y [1]."""
    @property
    def usable(self) -> bool:
        """Somebody may act on it."""
    @property
    def remarks(self) -> list[str]: ...
    @property
    def mean(self) -> _Singles:
        """Mean of each var [N] [1]."""
    @property
    def sigma(self) -> _Singles:
        """Standard deviation of each var [N] [1]."""
    @property
    def covariance(self) -> _Singles:
        """Covariance of the vars [N][N] [1]."""
    @property
    def map_params(self) -> _Singles:
        """Maximum a posteriori of each `ln var` [N] [1]."""
    @property
    def centre(self) -> _Singles:
        """Centre of the normal of each `ln var` before it is truncated to the prior's range [N] [1]."""
    @property
    def params_sigma(self) -> _Singles:
        """Its standard deviation [N] [1]."""
    @property
    def clipped(self) -> NDArray[np.bool_]:
        """Whether each var sits at a bound of the prior's range [N]."""
    @property
    def reading(self) -> NDArray[np.uint32]:
        """What became of each monitor's reading [B]: 0 did not report, 1 used, 2 rejected."""
    @property
    def monitor_state(self) -> list[str]:
        """`ok`, `noisy`, `jumps` or `dead` [B]."""
    @property
    def monitor_sigma(self) -> _Singles:
        """Noise of one reading of each monitor [B] [m]."""
    @property
    def monitor_rejected(self) -> NDArray[np.uint32]:
        """Readings of each monitor that were not used so far [B]."""
