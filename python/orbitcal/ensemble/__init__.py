"""Ensembles on `dask.distributed`: a task for each of many seeds, results to Parquet as they come (docs/scale.md).

from orbitcal import ensemble
table = ensemble.run(ensemble.Validation(recording, "single"), range(1000), "target/validation")
"""

from .engine import Costs, costs, failures, run
from .tasks import Calibration, TrainingSet, Validation
from .uniformity import histograms, uniformity

__all__ = ["Calibration", "Costs", "TrainingSet", "Validation", "costs", "failures", "histograms", "run", "uniformity"]
