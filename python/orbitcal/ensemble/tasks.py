"""What an ensemble runs: each task is made of a recording and gives a row for a seed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from typing import Any, Literal

import numpy as np

from .. import _orbitcal
from ..estimator import Estimator
from ..recording import Recording
from ..ring import Ring

Method = Literal["map", "core", "nuts"]


def _of(template: Recording) -> dict[str, str]:
    """What results depend on beside a task's own options: header and frames of its recording, its ring with vars and priors, the package."""
    ring = template.ring._ring
    made_of = json.dumps([template._recording.texts(ring), ring.state()])
    return {
        "template": template.name,
        "sha256": hashlib.sha256(made_of.encode()).hexdigest(),
        "orbitcal": _orbitcal.__version__,
    }


class Validation:
    """A blind campaign through the diagnosis, as of `orbitcal validate`: the seed is the number of the case.

    Classes: `empty` (no effect), `single`, `pair`, `unknown` (physics that the library does not hold). Rows have the words of
    `validate`'s outcomes: verdict, grade, what was made and found. Other rings take the recording of another ring.
    """

    COLUMNS = (
        "verdict",
        "grade",
        "made",
        "found",
        "probability",
        "is_true",
        "oracle_gain",
        "nees_before",
        "nees_after",
    )

    def __init__(
        self, template: Recording, kind: Literal["empty", "single", "pair", "unknown"], *, seed: int = 1
    ) -> None:
        self.template, self.kind, self.seed = template, kind, seed
        self.name = "validation"
        self.says = {**_of(template), "class": kind, "seed": seed}
        self._validation: _orbitcal.Validation | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_validation": None}

    def __call__(self, seed: int) -> dict[str, Any]:
        """The case of this number."""
        if self._validation is None:
            self._validation = _orbitcal.Validation(self.template.ring._ring, self.template._recording)
        made = self._validation.run(self.kind, seed, self.seed)
        if made is None:
            return dict.fromkeys(self.COLUMNS) | {"verdict": "no beam"}
        outcome = json.loads(made)
        values = (
            outcome["verdict"],
            outcome["grade"],
            [one["label"] for one in outcome["truth"]],
            outcome["found"],
            outcome["stated"]["probability"],
            outcome["stated"]["is_true"],
            outcome["oracle_gain"],
            *outcome["nees"],
        )
        return dict(zip(self.COLUMNS, values, strict=True))


class Calibration:
    """Simulation-based calibration: vars from the prior, a campaign made with them, and where they lie in each posterior.

    Rows have a list for each method, one number a var: the posterior probability below the true value, of NUTS the true value's place among the
    draws. If the posterior is right they are uniform from 0 to 1 (`uniformity`). Methods: `map` (batch fit), `core` (the no_std core), `nuts`.

    Source: S. Talts, M. Betancourt, D. Simpson, A. Vehtari and A. Gelman, arXiv:1804.06788 (2018).
    """

    def __init__(
        self, template: Recording, methods: Iterable[Method] = ("map", "core", "nuts"), *, draws: int = 400
    ) -> None:
        self.template, self.methods, self.draws = template, tuple(methods), draws
        self.name = "calibration"
        self.says = {**_of(template), "methods": list(self.methods), "draws": draws}

    def __call__(self, seed: int) -> dict[str, Any]:
        """The probabilities of one campaign."""
        recording, truth = Recording.simulated(self.template, seed, exact=False)
        return {method: getattr(self, f"_{method}")(recording, np.log(truth.values), seed) for method in self.methods}

    def _map(self, recording: Recording, params: np.ndarray, _: int) -> list[float]:
        mean, sigma = _orbitcal.marginals(recording.ring._ring, recording._recording)
        return _below(recording.ring, params, mean, sigma)

    def _core(self, recording: Recording, params: np.ndarray, _: int) -> list[float]:
        for estimate in Estimator(recording.ring, recording).stream(recording):
            last = estimate
        return _below(recording.ring, params, last.centre, last.params_sigma)

    def _nuts(self, recording: Recording, params: np.ndarray, seed: int) -> list[float]:
        # one chain, so that a worker takes one core; the design is exact, as the campaign's is
        ring, measured = recording.ring._ring, recording._recording
        _, drawn = _orbitcal.sample(ring, measured, "green", 1, 300, self.draws, seed, True, None)
        return _place((np.log(drawn["vars"][0]) < params).sum(axis=0), self.draws, seed)


def _below(ring: Ring, params: np.ndarray, mean: Iterable[float], sigma: Iterable[float]) -> list[float]:
    """Probability of a smaller `ln var`, of normals truncated to the prior's ranges."""
    from scipy.stats import truncnorm

    mean, sigma = np.asarray(mean, float), np.asarray(sigma, float)
    low, high = np.log(np.array(ring._ring.priors)[:, 1:]).T
    return truncnorm.cdf(params, (low - mean) / sigma, (high - mean) / sigma, mean, sigma).tolist()


def _place(below: np.ndarray, draws: int, seed: int) -> list[float]:
    """The place from 0 to 1 of a value that is above so many of the draws: by chance within one of the `draws + 1` equal parts.

    The number itself has `draws + 1` values, and 20 bins would not have equally many of these.
    """
    return ((below + np.random.default_rng(seed).random(len(below))) / (draws + 1)).tolist()


class TrainingSet:
    """Training data of a surrogate: vars from the ring's prior and the exact response of the twin to them [B][C] [m/rad]."""

    def __init__(self, template: Recording) -> None:
        self.template = template
        self.name = "training set"
        self.says = _of(template)

    def __call__(self, seed: int) -> dict[str, Any]:
        """One ring."""
        _, vars = Recording.simulated(self.template, seed, exact=False)
        response = self.template.ring.with_vars(vars).response()
        return {"vars": vars.tolist(), "response": response.values.ravel().tolist()}
