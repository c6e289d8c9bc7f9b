"""Whether probabilities of a calibration are uniform, var by var."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from ..ring import Ring

if TYPE_CHECKING:
    from ..figures import Drawn

BINS = 20
BAND = 0.99  # of the counts of one bin


def uniformity(table: pd.DataFrame, ring: Ring, *, level: float = 0.01) -> pd.DataFrame:
    """Chi-square of the histogram of each var's probabilities in 20 bins, one row a method and var.

    Columns: `chi2` (19 expected), `p` and `is_uniform`, at `level` divided by the number of tests (Bonferroni).
    """
    from scipy.stats import chi2

    rows = []
    for method, counts in _counts(table).items():
        expected = len(table) / BINS
        for name, of_var in zip(ring._ring.vars, counts, strict=True):
            statistic = float(((of_var - expected) ** 2).sum() / expected)
            rows.append({"method": method, "var": name, "chi2": statistic, "p": float(chi2.sf(statistic, BINS - 1))})
    result = pd.DataFrame(rows).set_index(["method", "var"])
    result["is_uniform"] = result["p"] > level / len(rows)
    return result


def histograms(table: pd.DataFrame) -> Drawn:
    """The histograms, a line a var over what is expected, their mean in bold, and where 99 % of the counts of one var should be."""
    from scipy.stats import binom

    from ..figures import COLOURS, Drawn

    counts = _counts(table)
    figure = Drawn(figsize=(3.4 * len(counts), 2.8), layout="constrained")
    axes = figure.subplots(1, len(counts), sharey=True, squeeze=False)[0]
    edges, expected = np.linspace(0, 1, BINS + 1), len(table) / BINS
    for ax, (method, of_vars) in zip(axes, counts.items(), strict=True):
        ax.axhspan(*(np.array(binom.interval(BAND, len(table), 1 / BINS)) / expected), color=COLOURS[0], alpha=0.35, lw=0)
        for of_var in of_vars:
            ax.stairs(of_var / expected, edges, color=COLOURS[1], alpha=0.2, lw=0.6)
        ax.stairs(of_vars.mean(axis=0) / expected, edges, color=COLOURS[1], lw=2)
        ax.set(title=f"{method}, {len(table)} campaigns", xlabel="posterior probability below the true var", xlim=(0, 1))
    axes[0].set_ylabel("count over expected")
    return figure


def _counts(table: pd.DataFrame) -> dict[str, np.ndarray]:
    """Of each method the counts of each var [vars][bins]."""
    methods = [name for name in table.columns if name != "seed"]
    of = lambda values: np.stack([np.histogram(column, BINS, (0, 1))[0] for column in np.stack(list(values)).T])
    return {method: of(table[method]) for method in methods}
