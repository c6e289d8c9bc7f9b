"""Convergence diagnostics of chains by ArviZ (PyPI: arviz==0.23.*), beside those of inference/src/diagnostics.rs.

Usage: arviz_diagnostics.py golden        rewrite tests/golden/draws/ and tests/golden/arviz.csv
       arviz_diagnostics.py check FOLDER  one line of JSON on the chains that lie in FOLDER

The golden chains have one fault each, from a fixed seed; six significant digits keep the files small. They are written,
then read back by `az.from_cmdstan`, so that ArviZ and the Rust side start from the same bits.
"""

import csv
import json
import sys
import warnings
from pathlib import Path

import numpy as np

warnings.filterwarnings("ignore", message="\\s*ArviZ is undergoing")  # a word on the next version
import arviz as az

GOLDEN = Path(__file__).resolve().parents[1] / "golden"
SEED, CHAINS, DRAWS = 20, 4, 400
STATS = ["lp__", "accept_stat__", "stepsize__", "treedepth__", "n_leapfrog__", "divergent__", "energy__"]
FIGURES = ["r_hat", "ess_bulk", "ess_tail", "mcse_mean"]


def main():
    match sys.argv[1:]:
        case ["golden"]:
            golden(GOLDEN / "draws", GOLDEN / "arviz.csv")
        case ["check", folder]:
            print(json.dumps(check(Path(folder))))
        case _:
            sys.exit(__doc__)


def golden(folder, answers):
    rng = np.random.default_rng(SEED)
    quantities = pathologies(rng)
    folder.mkdir(exist_ok=True)
    for chain in range(CHAINS):
        columns = {name: values[chain] for name, values in quantities.items()}
        write(folder / f"chain-{chain + 1}.csv", statistics(rng, chain), columns)
    rows = [figures(name, values) for name, values in draws(opened(folder)).items()]
    with answers.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["quantity", *FIGURES])
        writer.writerows(rows)


def pathologies(rng):
    """Quantities [chain, draw], each wrong in its own way."""
    shape = (CHAINS, DRAWS)
    mixed = rng.normal(size=shape)
    return {
        "mixed": mixed,
        "slow": autoregressive(rng, 0.95),
        "antithetic": autoregressive(rng, -0.6),  # its ESS is at the bound
        "alternating": autoregressive(rng, -0.3),
        "shifted": rng.normal(size=shape) + 1.5 * (np.arange(CHAINS) == 2)[:, None],
        "wide": rng.normal(size=shape) * (1 + 2 * (np.arange(CHAINS) == 1))[:, None],
        "cauchy": rng.standard_cauchy(size=shape),
        "ties": np.round(autoregressive(rng, 0.5)),
        "vars.1": 1 + 1e-3 * mixed,  # small against its mean, as a quadrupole factor is
        "vars.2": 1 + 1e-3 * (0.6 * mixed + 0.8 * rng.normal(size=shape)),
    }


def autoregressive(rng, phi):
    """`x_t = phi x_{t-1} + e_t`, from its stationary distribution of variance 1."""
    noise = rng.normal(size=(CHAINS, DRAWS))
    values = noise.copy()
    for t in range(1, DRAWS):
        values[:, t] = phi * values[:, t - 1] + np.sqrt(1 - phi**2) * noise[:, t]
    return values


def statistics(rng, chain):
    """Sampler statistics as NUTS would leave them; one divergence in the last chain."""
    divergent = np.zeros(DRAWS)
    divergent[100] = chain == CHAINS - 1
    depth = rng.integers(1, 5, size=DRAWS)
    lp = -rng.chisquare(9, size=DRAWS) / 2
    energy = rng.chisquare(9, size=DRAWS) / 2 - lp
    accepted = rng.uniform(size=DRAWS)
    return dict(zip(STATS, [lp, accepted, np.full(DRAWS, 0.5), depth, 2**depth - 1, divergent, energy]))


def write(path, stats, quantities):
    columns = {**stats, **quantities}
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        for row in zip(*columns.values()):
            writer.writerow(f"{value:.6g}" for value in row)


def opened(folder):
    """Posterior and sampler statistics of all chains of a folder, in their order."""
    paths = sorted(folder.glob("chain-*.csv"), key=lambda path: int(path.stem.removeprefix("chain-")))
    return az.from_cmdstan(posterior=[str(path) for path in paths])


def draws(data):
    """Draws [chain, draw] by the name of their column; the elements of a vector count from 1."""
    quantities = {}
    for name, values in data.posterior.items():
        for index in np.ndindex(*values.shape[2:]):
            column = ".".join([name, *(str(i + 1) for i in index)])
            quantities[column] = values.values[(..., *index)]
    return quantities


def figures(name, values):
    row = [
        az.rhat(values, method="rank"),
        az.ess(values, method="bulk"),
        az.ess(values, method="tail"),
        az.mcse(values, method="mean"),
    ]
    return [name, *(repr(float(figure)) for figure in row)]


def check(folder):
    """The worst figure over all quantities, and the number of divergences."""
    data = opened(folder)
    rows = [dict(zip(["quantity", *FIGURES], figures(*item))) for item in draws(data).items()]
    column = lambda figure: [float(row[figure]) for row in rows]
    return {
        "chains": data.posterior.sizes["chain"],
        "draws": data.posterior.sizes["draw"],
        "quantities": len(rows),
        "max_r_hat": np.max(column("r_hat")),
        "min_ess_bulk": np.min(column("ess_bulk")),
        "min_ess_tail": np.min(column("ess_tail")),
        "divergences": int(data.sample_stats.diverging.sum()),
    }


main()
