"""NUTS of numpyro and of blackjax on the density that `orbitcal fit --method nuts --model green` samples, beside it.

Usage: numpyro_nuts.py DENSITY.json ORBITCAL RECORDING, the first written by `density RECORDING` of the system tests.
PyPI: numpyro==0.22.0, blackjax==1.7.1, jax[cpu]==0.10.2, arviz==0.23.*

The density is written here in jax.numpy from the tables of the Green's function, and JAX differentiates it; value and
gradient must be those of the file. All sample in the same whitened coordinates from the MAP: 4 chains of 1000 + 2000
draws, a diagonal mass matrix, target acceptance 0.8, both cores. ESS and R-hat are ArviZ's on everybody's draws.
Exit status 1 if a mean or standard deviation of a var differs between samplers by more than 5 Monte Carlo errors.
"""

import os

CHAINS, WARM_UP, DRAWS, SEED = 4, 1000, 2000, 1
# a device a chain: the chains fill the cores, so that threads within one would only stand in each other's way
os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={CHAINS} --xla_cpu_multi_thread_eigen=false"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import json
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import blackjax
import jax.numpy as jnp
import numpy as np
import numpyro
from numpyro.infer.hmc import hmc

warnings.filterwarnings("ignore", message="\\s*ArviZ is undergoing")  # a word on the next version
import arviz as az

TOLERANCE = 1e-9  # of value and gradient, relative: rounding through a solve of 96 equations
MONTE_CARLO_ERRORS = 5  # of 96 comparisons the largest is about 3 where all agree


@dataclass
class Run:
    """Draws of the vars [chain][draw][var], and what they cost."""

    sampler: str
    draws: np.ndarray
    seconds: float
    cpu: float  # of all cores, compiling left out; ours with its batch fit, about a second [s]
    compilation: float
    evaluations: int  # of log-density and gradient, warm-up included
    divergences: int

    def __post_init__(self):
        each = [self.draws[:, :, i] for i in range(self.draws.shape[2])]
        self.ess = min(float(az.ess(var, method=method)) for var in each for method in ("bulk", "tail"))
        self.r_hat = max(float(az.rhat(var, method="rank")) for var in each)
        self.mean, self.sd = self.draws.mean(axis=(0, 1)), self.draws.std(axis=(0, 1), ddof=1)
        self.mcse_mean, self.mcse_sd = (
            np.array([az.mcse(var, method=method) for var in each]) for method in ("mean", "sd")
        )


def main(density, orbitcal, recording):
    file = json.loads(Path(density).read_text())
    model = Density(file)
    model.check(file["checks"])
    ours = fit(orbitcal, recording, "green")
    peers = [sampled(name, chain, model) for name, chain in PEERS.items()]
    twin = fit(orbitcal, recording, "twin")
    print_table([ours, *peers, twin])
    return 0 if all([agree(file["names"], ours, peer) for peer in peers]) else 1


class Density:
    """The log-density in whitened coordinates; symbols as in inference/src/model/green.rs and posterior.rs."""

    def __init__(self, file):
        green, laplace = file["green"], file["laplace"]
        self.planes = [{name: array(plane[name]) for name in plane} for plane in green["planes"]]
        self.dispersion = {name: array(value) for name, value in green["dispersion"].items()}
        forms = file["readings"]["forms"]
        self.gram, self.moment, self.square = (
            jnp.stack([array(form[name]) for form in forms]) for name in ("gram", "moment", "square")
        )
        self.supplies = jnp.array(file["readings"]["supplies"])
        self.centre, self.factor = array(laplace["centre"]), array(laplace["factor"])
        self.prior, self.bend = file["prior"], file["bend"]
        self.lower, self.upper = np.log(file["range"])

    def log_density(self, z):
        u = self.centre + self.factor @ z
        theta = self.params(u)
        away = theta - self.prior["mean"]
        value = -0.5 * self.chi_square(self.response(jnp.exp(theta + self.supplies)))
        return value - 0.5 * self.prior["precision"] * away @ away + self.log_slope(u).sum()

    def params(self, u):
        softplus, t = jax.nn.softplus, self.bend
        return self.lower + t * (softplus((u - self.lower) / t) - softplus((u - self.upper) / t))

    def log_slope(self, u):
        """`ln(d theta/du)`."""
        softplus, t = jax.nn.softplus, self.bend
        whole = np.log(-np.expm1(-(self.upper - self.lower) / t))
        return whole - softplus((self.lower - u) / t) - softplus((u - self.upper) / t)

    def response(self, strength):
        """Rows monitors, columns correctors and the RF."""
        x, y = self.planes
        d = self.dispersion
        excess_x, excess_y = (plane["weight"] * (jnp.repeat(strength, 2) - 1.0) for plane in (x, y))
        seen = solved(x, excess_x, jnp.column_stack([x["seen"], d["node"]]))
        along_x = x["direct"] - seen[:, :-1].T @ (excess_x[:, None] * x["driven"])
        along_y = y["direct"] - solved(y, excess_y, y["seen"]).T @ (excess_y[:, None] * y["driven"])
        nodes = seen[:, -1]
        compaction = d["compaction"] - (excess_x * d["node"]) @ nodes / d["circumference"]
        rf = (x["seen"].T @ (excess_x * nodes) - d["monitor"]) / (compaction - d["inverse_gamma_squared"])
        in_planes = jax.scipy.linalg.block_diag(along_x, along_y)
        return jnp.column_stack([in_planes, jnp.pad(rf, (0, along_y.shape[0]))])

    def chi_square(self, response):
        images = jnp.einsum("bij,bj->bi", self.gram, response) - 2.0 * self.moment
        return self.square.sum() + (response * images).sum()

    def vars(self, z):
        return jnp.exp(self.params(self.centre + z @ self.factor.T))

    def check(self, checks):
        """Leave if value or gradient is not that of the file."""
        evaluate = jax.jit(jax.value_and_grad(self.log_density))
        worst = 0.0
        for known in checks:
            value, gradient = evaluate(jnp.array(known["point"]))
            # against the largest slope, at least 1, which a normal density has one sigma out: at the MAP all are 0
            size = max(1.0, np.abs(known["gradient"]).max())
            off = np.abs(gradient - jnp.array(known["gradient"])).max() / size
            worst = max(worst, abs(value / known["value"] - 1.0), off)
        print(f"log-density and gradient at {len(checks)} points as the file has them: off by {worst:.1e} at most")
        if not worst < TOLERANCE:
            sys.exit(f"allowed: {TOLERANCE:.0e}")


def array(value):
    """A number, a list, or nalgebra's `[entries by columns, rows, columns]`, columns null for a vector."""
    match value:
        case [[*entries], int(rows), columns]:
            matrix = np.reshape(entries, (rows, columns or 1), order="F")
            return jnp.array(matrix if columns else matrix[:, 0])
    return jnp.array(value)


def solved(plane, excess, sides):
    """`(1 + G_qq D)^-1` of columns at the nodes, `D` the diagonal of the excess."""
    return jnp.linalg.solve(jnp.eye(len(excess)) + plane["mutual"] * excess, sides)


def numpyro_chain(log_density, start):
    """One chain as a function of its random key: positions, integrator steps, divergences."""
    begin, step = hmc(lambda z: -log_density(z), algo="NUTS")

    def one(state, _):
        state = step(state)
        return state, (state.z, state.num_steps, state.diverging)

    def chain(key):
        state = begin(start, WARM_UP, dense_mass=False, target_accept_prob=0.8, rng_key=key)
        return jax.lax.scan(one, state, length=WARM_UP + DRAWS)[1]

    return chain


def blackjax_chain(log_density, start):
    """The same by blackjax."""

    def chain(key):
        warm_up, sample = jax.random.split(key)
        adaptation = blackjax.window_adaptation(blackjax.nuts, log_density, target_acceptance_rate=0.8)
        (state, parameters), adapting = adaptation.run(warm_up, start, WARM_UP)
        step = blackjax.nuts(log_density, **parameters).step

        def one(state, key):
            state, info = step(key, state)
            return state, (state.position, info.num_integration_steps, info.is_divergent)

        kept = jax.lax.scan(one, state, jax.random.split(sample, DRAWS))[1]
        tuned = (adapting.state.position, adapting.info.num_integration_steps, adapting.info.is_divergent)
        return jax.tree.map(lambda *parts: jnp.concatenate(parts), tuned, kept)

    return chain


PEERS = {f"numpyro {numpyro.__version__}": numpyro_chain, f"blackjax {blackjax.__version__}": blackjax_chain}


def sampled(name, chain_of, model):
    keys = jax.random.split(jax.random.PRNGKey(SEED), CHAINS)
    start = time.perf_counter()
    chains = jax.pmap(chain_of(model.log_density, jnp.zeros(len(model.centre)))).lower(keys).compile()
    compiled = time.perf_counter()
    cpu = time.process_time()
    positions, steps, divergent = jax.block_until_ready(chains(keys))
    seconds, cpu = time.perf_counter() - compiled, time.process_time() - cpu
    draws = np.asarray(model.vars(positions[:, WARM_UP:]))
    divergences = int(divergent[:, WARM_UP:].sum())
    return Run(name, draws, seconds, cpu, compiled - start, int(steps.sum()), divergences)


def fit(orbitcal, recording, model):
    """Ours, as a user runs it."""
    with tempfile.TemporaryDirectory() as folder:
        answer = Path(folder, "answer.json")
        settings = ["--chains", CHAINS, "--warm-up", WARM_UP, "--draws", DRAWS, "--seed", SEED]
        command = [orbitcal, "fit", recording, "--method", "nuts", "--exact-design", "--model", model, *settings]
        command += ["--json", answer, "--save-draws", folder, "--quiet"]
        before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        subprocess.run([str(word) for word in command], check=True)
        cpu = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
        answer = json.loads(answer.read_text())
        chains = [read_chain(Path(folder, f"chain-{i + 1}.csv"), answer["vars"]) for i in range(CHAINS)]
    nuts = answer["nuts"]
    costs = [nuts["seconds"], cpu, 0.0, nuts["evaluations"], nuts["divergences"]]
    run = Run(f"orbitcal, {model}", np.array(chains), *costs)
    if abs(run.ess / nuts["ess_min"] - 1.0) > 1e-6:
        sys.exit(f"orbitcal says that its ESS is {nuts['ess_min']}, ArviZ {run.ess}")
    return run


def read_chain(path, names):
    """Draws [draw][var]; the sampler's statistics are the columns before."""
    return np.genfromtxt(path, delimiter=",", skip_header=1)[:, -len(names) :]


def print_table(runs):
    ours = runs[0].ess / runs[0].seconds
    head = ["sampler", "sampling/s", "CPU/s", "compiling/s", "gradients", "CPU us each"]
    rows = [[*head, "min ESS", "of 1000 gradients", "ESS/s", "max R-hat", "divergent", "ours over it"]]
    cores = min(CHAINS, os.cpu_count())
    for run in runs:
        rate, whole = run.ess / run.seconds, run.ess / (run.seconds + run.compilation)
        cost = [f"{run.seconds:.1f}", f"{run.cpu:.1f}", f"{run.compilation:.1f}", f"{run.evaluations}"]
        each = f"{1e6 * run.cpu / run.evaluations:.0f}"
        worth = [f"{run.ess:.0f}", f"{1e3 * run.ess / run.evaluations:.0f}", f"{rate:.0f} ({whole:.0f})"]
        checks = [f"{run.r_hat:.4f}", f"{run.divergences}"]
        rows.append([run.sampler, *cost, each, *worth, *checks, f"{ours / rate:.2f} ({ours / whole:.2f})"])
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    for row in rows:
        print("  ".join([row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:]))]))
    print(
        f"{CHAINS} chains of {WARM_UP} + {DRAWS} draws on {cores} cores, from the MAP. ESS/s and its"
        " ratio in brackets with compiling.\nThe gradient of orbitcal is written by hand, JAX differentiates for"
        " itself. The twin is another density, of the same readings.\nWhere other work shares the cores, CPU times tell more."
    )


def agree(names, ours, peer):
    """Whether means and standard deviations are the same but for Monte Carlo errors."""
    mean = np.abs(ours.mean - peer.mean) / np.hypot(ours.mcse_mean, peer.mcse_mean)
    sd = np.abs(ours.sd - peer.sd) / np.hypot(ours.mcse_sd, peer.mcse_sd)
    words = [f"{what} {off.max():.1f} ({names[off.argmax()]})" for what, off in (("means", mean), ("sds", sd))]
    print(f"orbitcal, green and {peer.sampler} differ at most, in Monte Carlo errors: {', '.join(words)}")
    return max(mean.max(), sd.max()) < MONTE_CARLO_ERRORS


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    sys.exit(main(*sys.argv[1:]))
