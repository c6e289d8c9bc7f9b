"""Response and Jacobian of a ring of ALS size by orbitcal beside pyAT's own, and what a call costs above Rust's own time.

One process, one thread; medians of several runs. Errors are the largest differences from orbits that pyAT tracks with kicks of ±2 urad and
changes of a gradient of ±1e-4, with the convergence that these take and five times as many steps in magnets.

Usage: response.py [us]      us: the median that `cargo run --release --example response` prints for the Booster
"""

import statistics
import sys
import time
import warnings

import als_size
import numpy as np
from als_size import at
from at.latticetools import OrbitResponseMatrix

import orbitcal

warnings.filterwarnings("ignore")
KICK = 2e-6  # rad
STEP = 1e-4  # of a gradient
SAMPLE = 6  # quadrupoles whose derivative is tracked, of 72


def timed(work, repeats):
    """The result and the median time [s]."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        made = work()
        seconds.append(time.perf_counter() - start)
    return made, statistics.median(seconds)


class Tracked:
    """pyAT's closed orbits."""

    def __init__(self, lattice):
        self.lattice = lattice
        self.monitors = at.get_uint32_index(lattice, at.Monitor)
        self.correctors = at.get_uint32_index(lattice, at.Corrector)
        self.quadrupoles = at.get_uint32_index(lattice, at.Quadrupole)

    def response(self, **precision):
        """x and y at all monitors to kicks in x and in y [2 monitors][2 correctors] [m/rad]."""
        made = np.empty((2, len(self.monitors), 2, len(self.correctors)))
        for column, corrector in enumerate(self.correctors):
            for plane in (0, 1):
                orbits = [self.orbit(corrector, plane, sign * KICK, precision) for sign in (1, -1)]
                made[:, :, plane, column] = (orbits[0] - orbits[1]) / (2 * KICK)
        return made.reshape(2 * len(self.monitors), -1)

    def orbit(self, corrector, plane, kick, precision):
        self.lattice[corrector].KickAngle = [kick * (plane == 0), kick * (plane == 1)]
        orbit = at.find_orbit4(self.lattice, 0.0, self.monitors, **precision)[1]
        self.lattice[corrector].KickAngle = [0.0, 0.0]
        return orbit.T[[0, 2]]

    def analytical(self):
        """The blocks of x to x and y to y, by pyAT's linear optics."""
        made = []
        for plane in "xy":
            matrix = OrbitResponseMatrix(self.lattice, plane, at.Monitor, at.Corrector)
            made.append(matrix.build_analytical())
        return made

    def slope(self, quadrupole, response):
        """Derivative of a response with respect to a gradient, by differences [m/rad per 1/m^2]."""
        element = self.lattice[quadrupole]
        k1, made = element.PolynomB[1], []
        for sign in (1, -1):
            element.PolynomB[1] = k1 + sign * STEP
            made.append(np.array(response()))
        element.PolynomB[1] = k1
        return (made[0] - made[1]) / (2 * STEP)


def line(what, seconds, error=None, than=None):
    words = [f"{what:44} {1e3 * seconds:10.2f} ms"]
    words.append("" if error is None else f"off by {error:.1e}")
    words.append("" if than is None else f"{than / seconds:6.0f} x as fast")
    print("  ".join(words).rstrip())


def finer(lattice):
    """The same ring with five times as many steps in magnets."""
    lattice = lattice.deepcopy()
    for one in lattice:
        if hasattr(one, "NumIntSteps"):
            one.NumIntSteps *= 5
    return lattice


def als():
    lattice = als_size.ring()
    tracked, ring = Tracked(lattice), orbitcal.Ring.from_pyat(lattice)
    reference = Tracked(finer(lattice))
    tunes = at.get_tune(lattice, get_integer=True)[:2]
    size = f"{lattice.circumference:.1f} m, {len(tracked.quadrupoles)} quadrupoles"
    print(
        f"pyAT {at.__version__}, orbitcal {orbitcal.__version__}: {size}, response {len(ring.monitors)} x {len(ring.correctors)}, tunes {tunes[0]:.4f} {tunes[1]:.4f}"
    )
    exact = reference.response(convergence=1e-12, max_iterations=50)
    half = len(exact) // 2
    blocks = lambda matrix: (matrix[:half, :half], matrix[half:, half:])
    own, seconds = timed(lambda: ring.response(), 21)
    by_orbits, orbits_s = timed(tracked.response, 3)
    by_optics, optics_s = timed(tracked.analytical, 5)
    line("response, pyAT's orbits of ±2 urad", orbits_s, abs(by_orbits - exact).max())
    line(
        "response, pyAT's linear optics (x-x, y-y)",
        optics_s,
        max(abs(a - b).max() for a, b in zip(by_optics, blocks(exact))),
    )
    line("response, orbitcal", seconds, abs(own.values - exact).max(), min(orbits_s, optics_s))
    jacobian(tracked, reference, ring, [orbits_s, optics_s], blocks)


def jacobian(tracked, reference, ring, seconds_of_pyat, blocks):
    quadrupoles = tracked.quadrupoles
    own, seconds = timed(lambda: ring.jacobian(by="quadrupole"), 7)
    by_optics, optics_s = timed(
        lambda: [tracked.slope(q, tracked.analytical) for q in quadrupoles[:: len(quadrupoles) // SAMPLE]], 1
    )
    # each of the gradients takes as long
    optics_s *= len(quadrupoles) / len(by_optics)
    precise = lambda: reference.response(convergence=1e-13, max_iterations=50)
    sample = quadrupoles[:: len(quadrupoles) // SAMPLE]
    exact = [reference.slope(q, precise) for q in sample]
    # orbitcal has focusing quadrupoles first, each named by its row of the lattice
    rows = [
        next(i for i, name in enumerate(own.quadrupole.values) if name == f"{tracked.lattice[q].FamName}.{q}")
        for q in sample
    ]
    error = max(abs(own.values[row] - slope).max() for row, slope in zip(rows, exact))
    off = max(abs(a - b).max() for one, slope in zip(by_optics, exact) for a, b in zip(one, blocks(slope)))
    largest = max(abs(slope).max() for slope in exact)
    line(f"Jacobian by {len(quadrupoles)} gradients, pyAT's orbits", 2 * len(quadrupoles) * seconds_of_pyat[0])
    line("Jacobian, pyAT's linear optics (x-x, y-y)", optics_s, off)
    line("Jacobian, orbitcal", seconds, error, optics_s)
    print(
        f"  errors of the Jacobian in m/rad per 1/m^2, of {len(sample)} gradients; its largest element is {largest:.0f}"
    )


def booster(rust_us):
    ring = orbitcal.Ring.booster()
    ring.response()
    _, seconds = timed(ring.response, 501)
    _, bare = timed(lambda: ring._ring.response([], "fixed-momentum"), 501)
    above = "" if rust_us is None else f"; {1e6 * seconds - rust_us:.1f} us above Rust's own {rust_us:.1f} us"
    print(f"Booster, Ring.response(): {1e6 * seconds:.1f} us, without its names {1e6 * bare:.1f} us{above}")


if __name__ == "__main__":
    als()
    booster(float(sys.argv[1]) if len(sys.argv) > 1 else None)
