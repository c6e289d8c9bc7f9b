"""Fit, sample, diagnose, compare: on a thread of their own, with a progress bar; Ctrl-C stops them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from . import _orbitcal
from .progress import bar
from .recording import Recording
from .results import Comparison, DiagnosisResult, FitResult
from .ring import Rf, Ring

if TYPE_CHECKING:
    import arviz


def fit(
    recording: Recording,
    ring: Ring | None = None,
    *,
    rf: Rf | None = None,
    exact_design: bool = False,
    progress: bool = False,
) -> FitResult:
    """The batch fit: damped Gauss-Newton on the exact twin to the maximum a posteriori, with its covariance.

    `ring` is the recording's unless another is given (other priors, for instance). Of a measured matrix `rf` says what the machine held
    while it was measured; the frequency without it. Dipoles, momentum and kick constants may be off as those of decks are, unless the
    design is exact.
    """
    ring = recording.ring if ring is None else ring
    with bar("fit", None, is_shown=progress) as hear:
        return FitResult.of(_orbitcal.fit(ring._ring, recording._recording, rf, exact_design, hear))


def sample(
    recording: Recording,
    ring: Ring | None = None,
    *,
    chains: int = 4,
    warm_up: int = 1000,
    draws: int = 2000,
    seed: int = 1,
    model: Literal["twin", "green", "resnet", "linear"] = "twin",
    exact_design: bool = False,
    progress: bool = True,
) -> arviz.InferenceData:
    """Full NUTS on the posterior of the vars, as ArviZ's InferenceData; nothing is written to disk.

    `posterior["vars"]` has the dimensions chain, draw and var [1]; `sample_stats` has ArviZ's names. The seed fixes every draw, and
    `exact_design` is as in `fit`. The JSON of `orbitcal fit --method nuts` is in `attrs["orbitcal"]` of the posterior, as text.
    """
    import arviz

    ring = recording.ring if ring is None else ring
    with bar("sample", chains * (warm_up + draws), is_shown=progress) as hear:
        outcome, drawn = _orbitcal.sample(
            ring._ring, recording._recording, model, chains, warm_up, draws, seed, exact_design, hear
        )
    data = arviz.from_dict(
        posterior={"vars": drawn.pop("vars")},
        sample_stats=drawn,
        coords={"var": ring._ring.vars},
        dims={"vars": ["var"]},
    )
    data.posterior.attrs.update(inference_library="orbitcal", inference_library_version=_orbitcal.__version__)
    data.posterior.attrs["orbitcal"] = outcome.json
    return data


def diagnose(
    recording: Recording,
    *others: Recording,
    ring: Ring | None = None,
    rf: Rf | None = None,
    progress: bool = True,
) -> DiagnosisResult:
    """What the model of a recording lacks, or of several of one machine together (docs/diagnosis.md).

    A recording of one measured matrix is diagnosed as docs/real-rings.md says; `rf` as in `fit`.
    """
    ring = recording.ring if ring is None else ring
    with bar("diagnose", None, is_shown=progress) as hear:
        all_of_them = [one._recording for one in (recording, *others)]
        return DiagnosisResult.of(_orbitcal.diagnose(ring._ring, all_of_them, rf, hear))


def compare(before: Recording, after: Recording, *, ring: Ring | None = None, progress: bool = False) -> Comparison:
    """What changed from one recording of a machine to another, or from one measured matrix to another."""
    ring = before.ring if ring is None else ring
    with bar("compare", None, is_shown=progress) as hear:
        return Comparison.of(_orbitcal.compare(ring._ring, before._recording, after._recording, hear))
