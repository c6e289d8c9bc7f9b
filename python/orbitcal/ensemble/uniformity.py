"""Whether probabilities of a calibration are uniform, var by var."""

from __future__ import annotations

import numpy as np
import pandas as pd

from ..ring import Ring

BINS = 20


def uniformity(table: pd.DataFrame, ring: Ring, *, level: float = 0.01) -> pd.DataFrame:
    """Chi-square of the histogram of each var's probabilities in 20 bins, one row a method and var.

    Columns: `chi2` (19 expected), `p` and `is_uniform`, at `level` divided by the number of tests (Bonferroni).
    """
    from scipy.stats import chi2

    methods = [name for name in table.columns if name not in ("seed",)]
    rows = []
    for method in methods:
        values = np.stack(list(table[method]))
        for at, name in enumerate(ring._ring.vars):
            counts, _ = np.histogram(values[:, at], BINS, (0, 1))
            expected = len(values) / BINS
            statistic = float(((counts - expected) ** 2).sum() / expected)
            rows.append({"method": method, "var": name, "chi2": statistic, "p": float(chi2.sf(statistic, BINS - 1))})
    result = pd.DataFrame(rows).set_index(["method", "var"])
    result["is_uniform"] = result["p"] > level / len(rows)
    return result
