"""Five storage rings and synchrotrons of invented design, as pyAT lattices and as machine files.

Each ring is written down once, element after element; the pyAT lattice that is tracked and the file ``ring.json``
come from the same lines.  Two quadrupole families are matched to the wanted tunes (in ring 2 a third one to the
dispersion), two sextupole families to the wanted chromaticities.

    ring1  collider-like FODO ring of protons: two straights without dipoles, all monitors and correctors of one plane
    ring2  double-bend light source of twelve cells: strong sextupoles, gradient in the dipoles, monitors of both planes
    ring3  small synchrotron of eight cells: long combined-function dipoles with edges, gap and a sextupole component
    ring4  electron booster: monitors and correctors of both planes, a trim family that is one parameter
    ring5  both tunes near a third of an integer: one sextupole far stronger than the others, QD in series with dipoles

Maps: pyAT's default passes, of the expanded Hamiltonian: ``StrMPoleSymplectic4Pass`` for quadrupoles and sextupoles,
without fringe fields of quadrupoles; ``BndMPoleSymplectic4Pass`` for dipoles, with linear edges; ``DriftPass``,
``CorrectorPass`` and ``ThinMPolePass``.

Units: metres, radians, GeV.  Signs are MAD's: x outward, y up, x' -= K1L x; k1 and k2 are MAD's K1 and K2 (pyAT's
``PolynomB[2]`` is K2/2).
"""
import contextlib
import io
import json
import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

with contextlib.redirect_stdout(io.StringIO()):             # pyAT announces on import that it has no plotting
    import at

REST_ENERGY = {"proton": 0.93827208816, "electron": 0.00051099895}       # [GeV]


class Instrument(NamedTuple):
    """A monitor or corrector in one plane, H or V."""

    name: str                                # as in the recording: x_F01, V_D16
    element: str                             # as in the lattice: P_F01, CV_D16
    plane: str


# ------------------------------------------------------------------------------------------------------------- the ring

class Ring:
    """A design lattice: the pyAT ``lattice``, the ``elements`` of the machine file, what is fitted, read and set."""

    def __init__(self, name, particle, kinetic_energy, families, k1):
        self.name = name
        self.particle = particle
        self.kinetic_energy = kinetic_energy                 # [GeV]
        self.families = families
        self.k1 = k1                                         # of each family [1/m^2]
        self.elements = []
        self.tracked = []                                    # the elements of pyAT
        self.circumference = 0.0                             # so far [m]

    def drift(self, length):
        """Free length."""
        self.tracked.append(at.Drift("d", length))
        self.circumference += length

    def add(self, gap, name, kind, length=0.0, present=True, **properties):
        """An element of the machine file after ``gap`` metres of free length; only the gap if it is not ``present``."""
        self.drift(gap)
        if not present:
            return
        start = round(self.circumference, 9)
        self.elements.append(dict(name=name, type=kind, s_start=start, length=length, **properties))
        make = {"quadrupole": self._quadrupole, "sbend": dipole, "sextupole": sextupole, "marker": marker,
                "corrector": corrector, "bpm": monitor}[kind]
        self.tracked.append(make(name, length, **properties))
        self.circumference += length

    def _quadrupole(self, name, length, family):
        gradient = self.k1[family]
        field = dict(PolynomB=[0.0, gradient, 0.0, 0.0], PolynomA=np.zeros(4))
        element = at.Quadrupole(name, length, gradient, NumIntSteps=16, **field)
        element.MaxOrder = 1
        return element

    def finish(self):
        """What follows from the complete list of elements; returns the ring."""
        rest = REST_ENERGY[self.particle]
        energy = self.kinetic_energy + rest
        self.rest_energy = rest
        self.gamma = energy / rest
        self.momentum = math.sqrt(energy ** 2 - rest ** 2)   # [GeV/c]
        self.beta = self.momentum / energy
        self.lattice = at.Lattice(self.tracked, name=self.name, energy=energy * 1e9, periodicity=1)
        self.index = {e.FamName: i for i, e in enumerate(self.lattice) if e.FamName != "d"}
        self._name_quadrupoles()
        self.monitors = self._instruments("bpm", "x_", "y_")
        self.correctors = self._instruments("corrector", "H_", "V_")
        return self

    def _name_quadrupoles(self):
        """Quadrupoles, their short names, the fitted parameters with their widths, and the recorded supplies."""
        self.quadrupoles = [e for e in self.elements if e["type"] == "quadrupole"]
        self.quadrupole_label = short_names(self.quadrupoles)
        self.parameters = {}                                 # names of the quadrupoles of each parameter
        self.prior_width = {}                                # standard deviation of each parameter's logarithm
        self.range = {}
        self.supplies = []
        for e in self.quadrupoles:
            family = self.families[e["family"]]
            parameter = e["family"] if family.get("fit") == "family" else self.quadrupole_label[e["name"]]
            self.parameters.setdefault(parameter, []).append(e["name"])
            self.prior_width[parameter] = family["prior_width"]
            self.range[parameter] = family["range"]
            supply = self.supply(e)
            if supply != "dipole" and supply not in self.supplies:
                self.supplies.append(supply)

    def supply(self, quadrupole):
        """Name of the supply of a quadrupole; "dipole" if it is in series with the dipoles."""
        return self.families[quadrupole["family"]].get("supply", quadrupole["family"])

    def _instruments(self, kind, horizontal_prefix, vertical_prefix):
        """All monitors or correctors, those of the horizontal plane first."""
        found = []
        for plane, prefix in (("H", horizontal_prefix), ("V", vertical_prefix)):
            labels = short_names([e for e in self.elements if e["type"] == kind and plane in e["plane"]])
            found += [Instrument(prefix + label, name, plane) for name, label in labels.items()]
        return found

    def write(self, path):
        """The machine file."""
        machine = dict(
            name=self.name + ", made with pyAT",
            circumference_m=round(self.circumference, 9),
            k1=self.k1,
            reference=dict(particle=self.particle, kinetic_energy_GeV=self.kinetic_energy),
            families=self.families,
            elements=self.elements,
        )
        with open(path, "w") as f:
            json.dump(machine, f, indent=1)


def dipole(name, length, angle, e1, e2, k1=0.0, k2=0.0, hgap=0.0, fint=0.0):
    """Sector dipole of pyAT, of MAD's parameters."""
    field = dict(PolynomB=[0.0, k1, k2 / 2, 0.0], PolynomA=np.zeros(4))
    element = at.Dipole(name, length, angle, k1, EntranceAngle=e1, ExitAngle=e2, NumIntSteps=24, **field)
    element.MaxOrder = 2
    if hgap:
        element.FullGap = 2 * hgap
        element.FringeInt1 = fint
        element.FringeInt2 = fint
    return element


def sextupole(name, length, k2, family):
    """Sextupole of pyAT; its ``family`` is only of interest to the machine file."""
    field = dict(PolynomB=[0.0, 0.0, k2 / 2, 0.0], PolynomA=np.zeros(4))
    element = at.Sextupole(name, length, k2 / 2, NumIntSteps=6, **field)
    element.MaxOrder = 2
    return element


def marker(name, length):
    """A place for stray fields: a thin multipole of no strength, or a drift if it has a length."""
    if length > 0:
        return at.Drift(name, length)
    element = at.ThinMultipole(name, [0, 0, 0, 0.0], [0, 0, 0, 0.0])
    element.MaxOrder = 3
    return element


def corrector(name, length, plane):
    """Thin corrector of pyAT, which can kick in both planes whatever its ``plane`` is."""
    return at.Corrector(name, 0.0, [0.0, 0.0])


def monitor(name, length, plane):
    """Monitor of pyAT."""
    return at.Monitor(name)


def short_names(elements):
    """Short name of each element by its full name: what follows the first "_", unless two elements would share it."""
    names = [e["name"] for e in elements]
    tails = [name.split("_", 1)[-1] for name in names]
    return {name: tail if tails.count(tail) == 1 and (tail == name or tail not in names) else name
            for name, tail in zip(names, tails)}


# -------------------------------------------------------------------------------------------------- optics and matching

def fractional_tunes(matrix):
    """Fractional tunes of a 4x4 one-turn matrix, that of the more horizontal mode first; None if unstable."""
    values, vectors = np.linalg.eig(matrix)
    form = np.kron(np.eye(2), np.array([[0, 1], [-1, 0]]))   # the symplectic form
    modes = []
    for value, vector in zip(values, vectors.T):
        action = (vector.conj() @ form @ vector).imag
        if action > 0:
            share_of_x = (vector[:2].conj() @ form[:2, :2] @ vector[:2]).imag / action
            modes.append((share_of_x, np.angle(value) / 2 / np.pi % 1, abs(value)))
    modes.sort(reverse=True)
    if len(modes) != 2 or max(abs(size - 1) for _, _, size in modes) > 1e-5:
        return None
    return modes[0][1], modes[1][1]


def match(build, start, tunes, constraint=None):
    """Gradients by family for these tunes (with their integers), and for ``constraint(optics)`` to vanish.

    ``build`` makes a ring from gradients by family, ``start`` holds the first ones.
    """
    families = list(start)
    misses = np.full(3 if constraint else 2, 30.0)           # of an unstable ring

    def residuals(gradients):
        ring = build(dict(zip(families, gradients)))
        try:
            _, _, optics = at.linopt2(ring.lattice, refpts=range(len(ring.lattice) + 1))
        except (at.AtError, ArithmeticError, ValueError):
            return misses
        advance = optics.mu[-1] / 2 / np.pi
        if not np.all(np.isfinite(advance)):
            return misses
        out = [advance[0] - tunes[0], advance[1] - tunes[1]]
        if constraint:
            out.append(constraint(optics))
        return np.array(out)

    scale = [abs(start[f]) * 0.05 for f in families]
    with np.errstate(all="ignore"):                          # of unstable rings on the way
        solution = least_squares(residuals, [start[f] for f in families], x_scale=scale, xtol=1e-12, ftol=1e-14)
    return {f: round(float(v), 6) for f, v in zip(families, solution.x)}


def chromaticity(ring, step=1e-4):
    """Change of both tunes with the relative momentum."""
    tunes = []
    for delta in (-step, step):
        matrix, _ = at.find_m44(ring.lattice, delta)
        tunes.append(np.array(fractional_tunes(matrix)))
    change = (tunes[1] - tunes[0] + 0.5) % 1 - 0.5
    return change / 2 / step


def correct_chromaticity(build, k1, start, wanted):
    """Sextupole strengths K2 of two families for the wanted chromaticities, by three Newton steps."""
    k2 = dict(start)
    families = list(start)
    for _ in range(3):
        miss = chromaticity(build(k1, k2)) - np.array(wanted)
        jacobian = np.zeros((2, 2))
        for j, family in enumerate(families):
            changed = dict(k2)
            changed[family] += 0.05
            jacobian[:, j] = (chromaticity(build(k1, changed)) - miss - np.array(wanted)) / 0.05
        step = np.linalg.solve(jacobian, -miss)
        for j, family in enumerate(families):
            k2[family] = round(float(k2[family] + step[j]), 5)
    return k2


# ------------------------------------------------------------------------------------------------------------ the rings

NO_SEXTUPOLES = {"SF": 0.0, "SD": 0.0}


def colliding_fodo(k1, k2=NO_SEXTUPOLES):
    """Ring 1: 24 FODO cells, without dipoles behind two focusing and two defocusing quadrupoles."""
    family = dict(prior_width=0.02, range=[0.85, 1.15])
    ring = Ring("colliding fodo", "proton", 3.2, {"QF": dict(family), "QD": dict(family)}, k1)
    angle = 2 * math.pi / 44
    for cell in range(1, 25):
        for half in "FD":
            n = f"{half}{cell:02d}"
            plane = "H" if half == "F" else "V"
            has_corrector = cell % 3 != (1 if half == "F" else 2)
            ring.add(0.3, f"C{plane}_{n}", "corrector", present=has_corrector, plane=plane)
            ring.add(0.3, f"P_{n}", "bpm", plane=plane)
            ring.add(0.2, f"Q{half}_{n}", "quadrupole", 0.8, family="Q" + half)
            ring.add(0.2, f"S{half}_{n}", "sextupole", 0.3, k2=k2["S" + half], family="S" + half)
            if cell in (6, 18):
                ring.drift(0.4)
                ring.drift(6.0)
            else:
                ring.add(0.4, f"B_{n}", "sbend", 6.0, angle=angle, e1=angle / 2, e2=angle / 2)
            ring.add(0.7, f"SLOT_{n}", "marker")
            ring.drift(0.8)
    return ring.finish()


def twelvefold_light_source(k1, k2=NO_SEXTUPOLES):
    """Ring 2: twelve double-bend cells, six monitors and three correctors each."""
    families = {family: dict(prior_width=0.01, range=[0.94, 1.06]) for family in k1}
    ring = Ring("twelvefold light source", "electron", 2.0, families, k1)
    angle = 2 * math.pi / 24
    bend = dict(angle=angle, e1=angle / 2, e2=angle / 2, k1=-0.45)
    for cell in range(1, 13):
        n = f"{cell:02d}"
        ring.add(1.9, f"BPM{n}-1", "bpm", plane="HV")
        ring.add(0.1, f"COR{n}-1", "corrector", plane="HV")
        ring.add(0.1, f"Q1A{n}", "quadrupole", 0.3, family="Q1")
        ring.add(0.35, f"Q2A{n}", "quadrupole", 0.4, family="Q2")
        ring.add(0.3, f"BPM{n}-2", "bpm", plane="HV")
        ring.add(0.2, f"BDA{n}", "sbend", 1.5, **bend)
        ring.add(0.3, f"SDA{n}", "sextupole", 0.2, k2=k2["SD"], family="SD")
        ring.add(0.4, f"BPM{n}-3", "bpm", plane="HV")
        ring.add(0.1, f"COR{n}-2", "corrector", plane="HV")
        ring.add(0.2, f"SF{n}", "sextupole", 0.2, k2=k2["SF"], family="SF")
        ring.add(0.2, f"Q3{n}", "quadrupole", 0.4, family="Q3")
        ring.add(0.3, f"GIRDER{n}", "marker")
        ring.add(0.4, f"BPM{n}-4", "bpm", plane="HV")
        ring.add(0.4, f"SDB{n}", "sextupole", 0.2, k2=k2["SD"], family="SD")
        ring.add(0.3, f"BDB{n}", "sbend", 1.5, **bend)
        ring.add(0.3, f"BPM{n}-5", "bpm", plane="HV")
        ring.add(0.2, f"Q2B{n}", "quadrupole", 0.4, family="Q2")
        ring.add(0.35, f"Q1B{n}", "quadrupole", 0.3, family="Q1")
        ring.add(0.1, f"COR{n}-3", "corrector", plane="HV")
        ring.add(0.1, f"BPM{n}-6", "bpm", plane="HV")
        ring.add(0.9, f"ID{n}", "marker")
        ring.drift(1.0)
    return ring.finish()


def small_synchrotron(k1):
    """Ring 3: eight cells of one long combined-function dipole, no sextupoles apart from the dipoles' own component."""
    families = {"QF": dict(supply="focus", prior_width=0.05, range=[0.7, 1.3]),
                "QD": dict(supply="defocus", prior_width=0.03, range=[0.8, 1.2])}
    ring = Ring("small synchrotron", "proton", 0.8, families, k1)
    bend = dict(angle=math.pi / 4, e1=0.12, e2=0.12, k1=-0.025, k2=-0.08, hgap=0.035, fint=0.5)
    for cell in range(1, 9):
        ring.add(0.5, f"SLOT_{cell}", "marker")
        ring.add(0.6, f"HC_{cell}", "corrector", plane="H")
        ring.add(0.15, f"PUX_{cell}", "bpm", present=cell != 5, plane="H")
        ring.add(0.15, f"QF_F{cell}", "quadrupole", 0.35, family="QF")
        ring.add(0.4, f"B_{cell}", "sbend", 3.0, **bend)
        ring.add(0.4, f"QD_D{cell}", "quadrupole", 0.35, family="QD")
        ring.add(0.15, f"PUY_{cell}", "bpm", present=cell not in (2, 6), plane="V")
        ring.add(0.15, f"VC_{cell}", "corrector", plane="V")
        ring.drift(1.8)
    return ring.finish()


def dual_plane_booster(k1, k2=NO_SEXTUPOLES):
    """Ring 4: 22 cells, all monitors and correctors of both planes; the trim family QT is fitted by one parameter."""
    families = {"QF": dict(prior_width=0.02, range=[0.85, 1.15]),
                "QD": dict(prior_width=0.02, range=[0.85, 1.15]),
                "QT": dict(fit="family", prior_width=0.03, range=[0.8, 1.2])}
    ring = Ring("dual plane booster", "electron", 3.0, families, k1)
    angle = 2 * math.pi / 44
    bend = dict(angle=angle, e1=angle / 2, e2=angle / 2)
    for cell in range(1, 23):
        n = f"{cell:02d}"
        ring.add(0.25, f"M.{n}.a", "bpm", plane="HV")
        ring.add(0.1, f"QF.{n}", "quadrupole", 0.4, family="QF")
        ring.add(0.1, f"K.{n}.a", "corrector", plane="HV")
        ring.add(0.1, f"SF.{n}", "sextupole", 0.15, k2=k2["SF"], family="SF")
        ring.add(0.6, f"BD.{n}.a", "sbend", 1.8, **bend)
        ring.add(0.4, f"M.{n}.b", "bpm", plane="HV")
        ring.add(0.1, f"QD.{n}", "quadrupole", 0.4, family="QD")
        ring.add(0.1, f"K.{n}.b", "corrector", plane="HV")
        ring.add(0.1, f"SD.{n}", "sextupole", 0.15, k2=k2["SD"], family="SD")
        ring.add(0.4, f"ST.{n}", "marker")
        ring.add(0.3, f"BD.{n}.b", "sbend", 1.8, **bend)
        ring.add(0.5, f"QT.{n}", "quadrupole", 0.2, family="QT")
        ring.drift(0.25)
    return ring.finish()


def third_integer_ring(k1, k2=NO_SEXTUPOLES):
    """Ring 5: 16 FODO cells; SX_F03 is stronger than the others by 6 /m^3, the QD are in series with the dipoles."""
    families = {"QF": dict(supply="main", prior_width=0.015, range=[0.9, 1.1]),
                "QD": dict(supply="dipole", prior_width=0.01, range=[0.92, 1.08])}
    ring = Ring("third integer ring", "proton", 4.1, families, k1)
    angle = 2 * math.pi / 32
    bend = dict(angle=angle, e1=angle / 2, e2=angle / 2)
    for cell in range(1, 17):
        n = f"{cell:02d}"
        strong = 6.0 if cell == 3 else 0.0
        ring.add(0.3, f"PH_F{n}", "bpm", present=cell not in (4, 12), plane="H")
        ring.add(0.1, f"QF_F{n}", "quadrupole", 0.7, family="QF")
        ring.add(0.15, f"DH_F{n}", "corrector", present=cell != 9, plane="H")
        ring.add(0.1, f"SX_F{n}", "sextupole", 0.3, k2=k2["SF"] + strong, family="SF")
        ring.add(0.35, f"B_F{n}", "sbend", 4.0, **bend)
        ring.add(0.5, f"SLOT_F{n}", "marker", 0.5)
        ring.add(0.2, f"PV_D{n}", "bpm", present=cell not in (7, 15), plane="V")
        ring.add(0.1, f"QD_D{n}", "quadrupole", 0.7, family="QD")
        ring.add(0.15, f"DV_D{n}", "corrector", present=cell != 2, plane="V")
        ring.add(0.1, f"SX_D{n}", "sextupole", 0.3, k2=k2["SD"], family="SD")
        ring.add(0.35, f"B_D{n}", "sbend", 4.0, **bend)
        ring.add(0.5, f"SLOT_D{n}", "marker")
        ring.drift(0.7)
    return ring.finish()


def make_ring(number):
    """One of the five rings, matched."""
    if number == 1:
        k1 = match(colliding_fodo, {"QF": 0.16, "QD": -0.155}, (5.23, 4.37))
        return colliding_fodo(k1, correct_chromaticity(colliding_fodo, k1, {"SF": 0.1, "SD": -0.1}, (-1, -1)))
    if number == 2:
        def dispersion(optics):
            return 5 * (optics.dispersion[0, 0] - 0.08)      # 0.08 m in the long straight
        k1 = match(twelvefold_light_source, {"Q1": -1.6226, "Q2": 2.6012, "Q3": 2.0557}, (10.28, 5.36), dispersion)
        k2 = correct_chromaticity(twelvefold_light_source, k1, {"SF": 5.0, "SD": -5.0}, (0.5, 0.5))
        return twelvefold_light_source(k1, k2)
    if number == 3:
        return small_synchrotron(match(small_synchrotron, {"QF": 0.6, "QD": -0.6}, (2.28, 1.69)))
    if number == 4:
        trim = {"QT": 0.25}
        k1 = match(lambda k: dual_plane_booster({**k, **trim}), {"QF": 1.0, "QD": -1.0}, (6.28, 5.36)) | trim
        return dual_plane_booster(k1, correct_chromaticity(dual_plane_booster, k1, {"SF": 3.0, "SD": -3.0}, (0, 0)))
    if number == 5:
        k1 = match(third_integer_ring, {"QF": 0.3, "QD": -0.3}, (4.345, 4.362))
        return third_integer_ring(k1, correct_chromaticity(third_integer_ring, k1, {"SF": 0.3, "SD": -0.3}, (-2, -2)))
    raise ValueError(f"no such ring: {number}")
