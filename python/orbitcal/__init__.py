"""Real-time Bayesian calibration of an accelerator's digital twin.

    import orbitcal
    ring = orbitcal.Ring.booster()
    recording = orbitcal.Recording.read("recordings/paper-vars", ring)
    result = orbitcal.fit(recording)

Errors are those of the program `orbitcal`, with the same words: `InputError` for what was given, `OrbitcalError` for the rest.
"""

from ._orbitcal import InputError, OrbitcalError, __version__
from .estimator import Correction, Estimate, Estimator, Subscriber
from .recording import Recording
from .records import Change, Finding, Monitor, Var
from .results import Comparison, DiagnosisResult, FitResult
from .ring import Ring
from .work import compare, diagnose, fit, sample

__all__ = [
    "Change",
    "Comparison",
    "Correction",
    "DiagnosisResult",
    "Estimate",
    "Estimator",
    "Finding",
    "FitResult",
    "InputError",
    "Monitor",
    "OrbitcalError",
    "Recording",
    "Ring",
    "Subscriber",
    "Var",
    "__version__",
    "compare",
    "diagnose",
    "fit",
    "sample",
]
