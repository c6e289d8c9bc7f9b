"""Time the full orbit response of the Booster with pyAT (PyPI: accelerator-toolbox) on one core.

48 monitor places x 48 correctors, x and y, half the difference of the closed orbits at +-0.2 mrad over the kick: the
numbers of tests/golden/reference-effects.json, which the timed answer must reproduce. Beside it pyAT's own shorter way:
the response in each corrector's plane from its linear optics, for small kicks. One line of output.
"""

import contextlib
import io
import json
import statistics
import sys
import time
import warnings
from pathlib import Path

import numpy as np

with contextlib.redirect_stdout(io.StringIO()):  # a word on plotting, which is not used
    import at
    from at.latticetools import OrbitResponseMatrix

warnings.filterwarnings("ignore", message="AT tracking still assumes beta==1")  # matters at fixed frequency only

ROOT = Path(__file__).resolve().parents[2]
KICK = 0.2e-3  # rad
REPEATS = 7
STEPS = 20  # of a quadrupole, as in the golden file: 10 are off by 7e-5 m/rad; a sector without gradient needs one
TOLERANCE = 2e-6  # m/rad: six decimals in the golden file, and the closed orbit's own convergence


def ring_of(machine, steps=STEPS):
    """The machine file as pyAT elements, gaps filled with drifts; also the places of monitors and correctors."""
    elements, end = [], 0.0
    for e in machine["elements"]:
        if e["s_start"] - end > 1e-9:
            elements.append(at.Drift("D", e["s_start"] - end))
        elements.append(element_of(e, machine["k1"], steps))
        end = e["s_start"] + e["length"]
    if machine["circumference_m"] - end > 1e-9:
        elements.append(at.Drift("D", machine["circumference_m"] - end))
    for element in elements:
        if isinstance(element, at.Drift):
            element.PassMethod = "ExactDriftPass"
    ring = at.Lattice(elements, name="booster", energy=energy(machine), particle="proton", periodicity=1)
    ring.disable_6d()
    return ring, places(ring, "PU"), places(ring, "DC")


def element_of(e, k1, steps):
    name, length = e["name"], e["length"]
    match e["type"]:
        case "corrector":
            return at.Corrector(name, 0.0, [0.0, 0.0])
        case "bpm":
            return at.Monitor(name)
        case "marker":
            return at.Marker(name)
        case "sextupole" if e.get("k2", 0.0) == 0.0:
            return at.Drift(name, length)
        case "sextupole":
            return at.Sextupole(name, length, e["k2"] / 2, NumIntSteps=steps)
        case "quadrupole":
            strength = e.get("k1", k1.get(e.get("family")))
            return at.Quadrupole(name, length, strength, PassMethod="ExactMultipolePass", NumIntSteps=steps)
        case "sbend" if e.get("k1", 0.0) == 0.0:
            return at.Dipole(name, length, e["angle"], PassMethod="ExactSectorBendPass", NumIntSteps=1)
        case "sbend":
            body = [0.0, e["k1"], e["k2"] / 2]
            return at.Dipole(name, length, e["angle"], e["k1"], PolynomB=body, MaxOrder=2, NumIntSteps=steps)
    raise SystemExit(f"element {name}: no pyAT element for type {e['type']!r}")


def energy(machine):
    """Total energy [eV]."""
    return 0.93827208816e9 + machine["reference"]["kinetic_energy_GeV"] * 1e9


def places(ring, prefix):
    """Indices of elements, horizontal in beam order, then vertical."""
    names = [e.FamName for e in ring]
    return [i for plane in "HV" for i, name in enumerate(names) if name.startswith(f"{prefix}{plane}_")]


def response(ring, monitors, correctors, kick=KICK):
    """x and y at the monitors per kick [m/rad], shape (2, monitors, correctors)."""
    order = np.argsort(monitors)
    refpts = np.asarray(monitors)[order]
    answer = np.empty((2, len(monitors), len(correctors)))
    for j, corrector in enumerate(correctors):
        plane = 0 if ring[corrector].FamName.startswith("DCH") else 1
        orbits = []
        for sign in (1, -1):
            angle = [0.0, 0.0]
            angle[plane] = sign * kick
            ring[corrector].KickAngle = angle
            orbits.append(at.find_orbit4(ring, 0.0, refpts)[1][:, [0, 2]])
        ring[corrector].KickAngle = [0.0, 0.0]
        answer[:, order, j] = ((orbits[0] - orbits[1]) / (2 * kick)).T
    return answer


def analytic(ring, monitors, correctors):
    """x at monitors to H correctors, y to V correctors [m/rad], shape (2, monitors, half the correctors)."""
    order = np.argsort(monitors)
    answer = np.empty((2, len(monitors), len(correctors) // 2))
    for i, (plane, name) in enumerate((("x", "DCH"), ("y", "DCV"))):
        steerers = [c for c in correctors if ring[c].FamName.startswith(name)]
        matrix = OrbitResponseMatrix(ring, plane, sorted(monitors), steerers)
        matrix.build_analytical()
        answer[i, order] = matrix.response
    return answer


def timed(work, *arguments):
    """Answer and median time [ms]."""
    seconds = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        answer = work(*arguments)
        seconds.append(time.perf_counter() - start)
    return answer, statistics.median(seconds) * 1e3


def main():
    machine = json.loads((ROOT / "machines/booster.json").read_text())
    golden = json.loads((ROOT / "tests/golden/reference-effects.json").read_text())["cases"]["nominal"]
    ring, monitors, correctors = ring_of(machine)
    known = np.array([golden["response_x_m_per_rad"], golden["response_y_m_per_rad"]])
    answer, tracked_ms = timed(response, ring, monitors, correctors)
    error = np.abs(answer - known).max()
    if error > TOLERANCE:
        sys.exit(f"pyAT {at.__version__}: off the golden numbers by {error:.1e} m/rad, allowed {TOLERANCE:.0e}")
    answer, analytic_ms = timed(analytic, ring, monitors, correctors)
    in_plane = np.array([known[0, :, :24], known[1, :, 24:]])
    print(
        f"pyAT {at.__version__}, median of {REPEATS}: full response {tracked_ms:.0f} ms, off by {error:.1e} m/rad;"
        f" in-plane from linear optics {analytic_ms:.0f} ms, off by {np.abs(answer - in_plane).max():.1e} m/rad"
    )


if __name__ == "__main__":
    main()
