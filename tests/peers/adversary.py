"""Blind recordings for a diagnosis of missing physics in the AGS Booster.

The program simulates orbit-response campaigns with pyAT's exact maps on the neutral machine description (``booster.json``) and
writes each one as a folder with ``header.toml``, ``frames.csv`` and ``truth.json``.  It shares no code with the program that reads
them: optics, orbits, tunes and the gains in ``truth.json`` all come from tracking with pyAT.

    python adversary.py --machine booster.json --out DIR [--set empty single kinds several unknown] [--only 3 7]
    python adversary.py --machine booster.json --check reference.json reference-effects.json

Maps: ``ExactDriftPass``; ``ExactMultipolePass`` for quadrupoles and sextupoles, without quadrupole fringe fields;
``ExactSectorBendPass`` with ``FringeBendEntrance = FringeBendExit = 1`` for dipoles; ``CorrectorPass`` and ``ThinMPolePass``
for thin elements.

Units: metres and radians inside, millimetres in the recordings.  Signs are MAD's: x outward, y up, x' -= K1L x, y' += K1sL x.
"""
import argparse
import contextlib
import io
import json
import math
import os
import time

import numpy as np

with contextlib.redirect_stdout(io.StringIO()):             # pyAT announces on import that it has no plotting
    import at

H_CELLS = [s + n for s in "ABCDEF" for n in "2468"]
V_CELLS = [s + n for s in "ABCDEF" for n in "1357"]
CELLS = H_CELLS + V_CELLS                    # the order of the vars and of the correctors
SLOTS = [s + n for s in "ABCDEF" for n in "36"]

SIGMA = 0.15e-3                              # a reading's noise [m]
FULL_CURRENT = 22.0                          # strongest corrector setting [A]
KICK_PER_AMPERE = 0.2e-3 / 22.0              # rounded to 0.00909091 mrad/A in the header
NOMINAL = {"dipole": 2400.0, "qh": 1800.0, "qv": 1790.0}
TRANSFER = np.array([0.0016, 1.0121, -0.0021, -0.0052, -0.0049, -0.0015])
LOOP_MONITORS = ("x_D8", "x_E6")
GAMMA = 1.0 + 1500.0 / 938.27208816
RF_STEP = 2e-4
NOISY_MONITOR, JUMPING_MONITOR = "x_C6", "y_B5"
PRIOR = 0.03                                 # standard deviation of ln var

HEADER = '''# Orbit-response campaign. Units and signs: positions in mm, x outward, y up; currents in A; corrector currents
# are read-backs, a positive current kicks to positive x (H) or y (V); drf_rel is the relative RF frequency offset.
machine = "ags-booster"
lattice = "booster.json"
recorded_with = "pyAT 0.9, exact maps"
particle = "proton"
kinetic_energy_GeV = 1.5
bpm_sigma_mm = 0.15          # expected, per reading
kick_mrad_per_A = 0.00909091
kick_convention = "one setting per frame; 0 A frames are the baseline"
believed_rf = "fixed_momentum" # what the operators believe the beam was held at
nominal_A = { dipole = 2400.0, qh = 1800.0, qv = 1790.0 }
# k1 = var * k1_design * p(I/I_nominal) / p(1) / (I_dipole / I_dipole_nominal), p(r) = sum(c_n r^n)
quad_transfer = [0.0016, 1.0121, -0.0021, -0.0052, -0.0049, -0.0015]
radial_loop_monitors = ["x_D8", "x_E6"] # the pair a radial loop would hold, if one were on
note = ""
'''


# ---------------------------------------------------------------------------------------------------------------- the ring

class Ring:
    """One state of the machine that does not change during a campaign: strengths, misalignments, static field errors."""

    def __init__(self, machine, vars_=None):
        self.machine = machine
        self.monitors = ["x_" + c for c in machine["data"]["bpm_x"]] + ["y_" + c for c in machine["data"]["bpm_y"]]
        self.dipoles = [e["name"] for e in machine["elements"] if e["type"] == "sbend"]
        self.vars = np.ones(48) if vars_ is None else np.array(vars_, float)
        self.shift = np.zeros((48, 2))                       # of the quadrupoles [m]
        self.roll = np.zeros(48)                             # of the quadrupoles [rad]
        self.quad_k2l = np.zeros(48)
        self.dipole_k1l = np.zeros(36)
        self.dipole_k2l = np.zeros(36)
        self.dipole_edge = np.zeros(36)
        self.sextupole_k2l = np.zeros(48)
        self.slot_normal = np.zeros((12, 4))                 # thin K(n)L in the free straights, n = 0..3
        self.slot_skew = np.zeros((12, 4))
        self.slot_matrix = [None] * 12                       # any other thin 4x4 map there

    def copy(self):
        """An independent copy, to which an effect can be applied."""
        new = Ring.__new__(Ring)
        for key, value in self.__dict__.items():
            new.__dict__[key] = value.copy() if isinstance(value, np.ndarray) else list(value) if isinstance(value, list) else value
        return new

    def k1_design(self):
        """Design gradient of every quadrupole, in the order of the vars."""
        k = self.machine["k1"]
        return np.array([k["QH"]] * 24 + [k["QV"]] * 24)


class Tracker:
    """A pyAT lattice of a ``Ring``, with the quantities that change from frame to frame written straight into its elements."""

    latest = None                                            # the one that was tracked last
    STEPS = 5                                                # integration steps in half a quadrupole, or a dipole

    def __init__(self, ring):
        self.ring = ring
        self.circumference = ring.machine["circumference_m"]
        elements, position, monitors, quads = [], 0.0, {}, {}
        self.quad_field, self.corrector_kick, self.slot_kick, self.slot_field = {}, {}, {}, {}

        def drift(length):
            if length > 1e-12:
                elements.append(at.Drift("D", length, PassMethod="ExactDriftPass"))

        for e in ring.machine["elements"]:
            drift(e["s_start"] - position)
            position = e["s_start"] + e["length"]
            kind, cell = e["type"], e["name"].split("_")[1]
            i = CELLS.index(cell)
            if kind == "corrector":
                elements.append(at.Corrector(e["name"], 0.0, [0.0, 0.0]))
                self.corrector_kick[i] = elements[-1].KickAngle
            elif kind == "bpm":
                monitors[cell] = len(elements)
                elements.append(at.Monitor(e["name"]))
            elif kind == "marker":
                j = SLOTS.index(cell)
                elements.append(at.Corrector("KICK_" + cell, 0.0, [0.0, 0.0]))
                self.slot_kick[j] = elements[-1].KickAngle
                if np.any(ring.slot_normal[j]) or np.any(ring.slot_skew[j]):
                    factorial = np.array([1.0, 1.0, 2.0, 6.0])
                    thin = at.ThinMultipole("THIN_" + cell, ring.slot_skew[j] / factorial, ring.slot_normal[j] / factorial)
                    elements.append(thin)
                    self.slot_field[j] = [(thin.PolynomA, thin.PolynomA.copy()), (thin.PolynomB, thin.PolynomB.copy())]
                if ring.slot_matrix[j] is not None:
                    m = np.eye(6)
                    m[:4, :4] = ring.slot_matrix[j]
                    elements.append(at.M66("MAP_" + cell, m))
            elif kind == "sextupole":
                if ring.sextupole_k2l[i]:
                    elements.append(at.Sextupole(e["name"], e["length"], ring.sextupole_k2l[i] / e["length"] / 2,
                                                 PassMethod="ExactMultipolePass", NumIntSteps=2))
                else:
                    drift(e["length"])
            elif kind == "quadrupole":
                quads[i] = len(elements)
                self.quad_field[i] = []
                for _ in range(2):                           # two halves, so that the orbit in the centre is known too
                    half = at.Quadrupole(e["name"], e["length"] / 2, ring.machine["k1"][e["family"]],
                                         PassMethod="ExactMultipolePass", NumIntSteps=self.STEPS)
                    half.PolynomB, half.PolynomA = np.zeros(3), np.zeros(3)
                    half.MaxOrder = 2 if ring.quad_k2l[i] else 1
                    half.PolynomB[2] = ring.quad_k2l[i] / e["length"] / 2
                    if np.any(ring.shift[i]):
                        at.shift_elem(half, *ring.shift[i])
                    if ring.roll[i]:
                        at.tilt_elem(half, ring.roll[i])
                    elements.append(half)
                    self.quad_field[i].append(half.PolynomB)
            elif kind == "sbend":
                j = ring.dipoles.index(e["name"])
                bend = at.Dipole(e["name"], e["length"], e["angle"], 0.0, PassMethod="ExactSectorBendPass", NumIntSteps=self.STEPS,
                                 EntranceAngle=ring.dipole_edge[j], ExitAngle=ring.dipole_edge[j],
                                 FringeBendEntrance=1, FringeBendExit=1)
                k1, k2 = ring.dipole_k1l[j] / e["length"], ring.dipole_k2l[j] / e["length"]
                bend.PolynomB, bend.PolynomA = np.zeros(3), np.zeros(3)
                bend.MaxOrder = 2 if k2 else 1 if k1 else 0
                bend.PolynomB[1:] = k1, k2 / 2
                elements.append(bend)
        drift(self.circumference - position)
        self.elements = at.Lattice(elements, energy=2.438e9, periodicity=1)
        cells = [m[2:] for m in ring.monitors]
        points = sorted({monitors[c] for c in CELLS} | {quads[i] + k for i in range(48) for k in range(3)})
        self.points = np.array(points, dtype=np.uint32)
        where = {p: n for n, p in enumerate(points)}
        self.at_monitors = np.array([where[monitors[c]] for c in cells])
        self.at_all_monitors = np.array([where[monitors[c]] for c in CELLS])
        self.at_quads = np.array([[where[quads[i] + k] for k in range(3)] for i in range(48)])
        self.loop = [cells.index(m[2:]) for m in LOOP_MONITORS]
        self.end = np.array([len(elements)], dtype=np.uint32)

    def set(self, gradients, kicks, slot_kicks=None, slot_on=None):
        """Write one frame's quadrupole gradients (48), corrector kicks (48, 2), and what acts in the free straights."""
        for i in range(48):
            for field in self.quad_field[i]:
                field[1] = gradients[i]
            self.corrector_kick[i][:] = kicks[i]
        if slot_kicks is not None:
            for j, kick in self.slot_kick.items():
                kick[:] = slot_kicks[j]
        if slot_on is not None:
            for j, fields in self.slot_field.items():
                for field, full in fields:
                    field[:] = full * slot_on[j]

    def turn(self, start, points):
        """Track the columns of ``start`` (6, n) once round the ring; coordinates at ``points``."""
        kept = Tracker.latest is self                        # pyAT keeps the latest lattice, which shares our arrays
        Tracker.latest = self
        out = at.lattice_pass(self.elements, np.asfortranarray(start), refpts=points, keep_lattice=kept)
        return out[:, :, :, 0]

    def orbit(self, guess, hold=("momentum", 0.0), exact_jacobian=True, jacobian=None):
        """Closed orbit near ``guess`` (x, px, y, py, delta).

        ``hold`` says what is kept: ("momentum", delta), ("frequency", relative offset, path length of the reference orbit) or
        ("loop", mean x of the two loop monitors).  Returns start, coordinates at the points, derivatives of one turn (rows: six
        coordinates and the loop's mean; columns x, px, y, py, delta), path length over the circumference.
        """
        z = np.array(guess, float)
        matrix = jacobian
        if hold[0] == "momentum":
            z[4] = hold[1]
        step = 1e-6
        for iteration in range(12):
            if (exact_jacobian and iteration == 0) or iteration in (4, 8):
                start = np.zeros((6, 6))
                start[:5, :] = z[:, None]
                start[[0, 1, 2, 3, 4], [1, 2, 3, 4, 5]] += step
                tracked = self.turn(start, np.append(self.points, self.end))
                final, inside = tracked[:, :, -1], tracked[:, 0, :-1]
                full = (final[:, 1:] - final[:, :1]) / step  # 6 x 5
                loop_row = (tracked[0][1:, self.at_monitors[self.loop]].mean(1) - tracked[0][0, self.at_monitors[self.loop]].mean()) / step
                matrix = np.vstack([full, loop_row])
                out = final[:, 0]
            else:
                start = np.zeros((6, 1))
                start[:5, 0] = z
                tracked = self.turn(start, np.append(self.points, self.end))
                out, inside = tracked[:, 0, -1], tracked[:, 0, :-1]
            residual = np.zeros(5)
            residual[:4] = out[:4] - z[:4]
            j = np.zeros((5, 5))
            j[:4] = matrix[:4]
            j[:4, :4] -= np.eye(4)
            if hold[0] == "momentum":
                j[4, 4] = 1.0
            elif hold[0] == "frequency":
                length = self.circumference + out[5]
                residual[4] = math.log(length / (self.circumference + hold[2])) - math.log(beta(z[4]) / beta(0.0)) + math.log1p(hold[1])
                j[4] = matrix[5] / length
                j[4, 4] -= 1.0 / ((GAMMA * (1 + z[4])) ** 2)
            else:
                residual[4] = inside[0, self.at_monitors[self.loop]].mean() - hold[1]
                j[4] = matrix[6]
            if np.max(np.abs(residual)) < 2e-10:
                return z, inside, matrix, out[5]
            z -= np.linalg.solve(j, residual)
        raise RuntimeError("no closed orbit")


def beta(delta):
    """Speed over c at relative momentum offset ``delta`` from 1.5 GeV kinetic energy."""
    p = math.sqrt(GAMMA ** 2 - 1) * (1 + delta)
    return p / math.sqrt(1 + p * p)


def tunes(matrix):
    """Fractional tunes (x, y) of a 4x4 one-turn matrix, weakly coupled, both above one half."""
    values, vectors = np.linalg.eig(matrix[:4, :4])
    if np.max(np.abs(np.abs(values) - 1)) > 1e-3 or np.min(np.abs(values.imag)) < 1e-3:
        raise RuntimeError("unstable")
    best = {}
    for value, vector in zip(values, vectors.T):
        weight = abs(vector[:2] @ vector[:2].conj())
        if value.imag > 0:
            best[weight] = 1.0 - abs(np.angle(value)) / (2 * np.pi)
    keys = sorted(best)
    return best[keys[-1]], best[keys[0]]


# ------------------------------------------------------------------------------------------------------------ the campaign

class Plan:
    """What was set and what flowed: settings, supply currents, corrector currents, frame by frame."""

    def __init__(self, rng):
        rows = []
        missing = {("C6", -22), ("A1", -22), ("E3", 22), ("E7", -22)}
        no_v = "A3 A5 A7 B1 B3 B5 B7 C1 C3 C5".split()
        for cells, wanted in (([c for c in H_CELLS if c != "D6"], 224), ([c for c in V_CELLS if c not in no_v], 113)):
            groups = [(c, a) for c in cells for a in (0, 22, -22) if (c, a) not in missing]
            repeats = np.full(len(groups), 3)
            change = 1 if wanted > 3 * len(groups) else -1
            repeats[rng.choice(len(groups), abs(wanted - 3 * len(groups)), replace=False)] += change
            rows += [(c, a, 0.0) for (c, a), n in zip(groups, repeats) for _ in range(n)]
        rows += [("", 0, d) for d in (0.0, RF_STEP, -RF_STEP) for _ in range(3)]
        self.corrector = [r[0] for r in rows]
        self.setting = np.array([r[1] for r in rows], float)
        self.drf = np.array([r[2] for r in rows])
        n = self.frames = len(rows)
        self.supply = {k: v * (1 + 2e-4 * rng.standard_normal(n)) for k, v in NOMINAL.items()}
        self.read_back = {k: v * (1 + 3e-5 * rng.standard_normal(n)) for k, v in self.supply.items()}
        self.current = 0.02 * rng.standard_normal((n, 48))
        for f, (c, a, _) in enumerate(rows):
            if c:
                self.current[f, CELLS.index(c)] += a
        self.sextupole_current = 0.05 + 0.01 * rng.standard_normal((n, 2))

    def gradients(self, ring):
        """Quadrupole gradients (frames, 48) from the supply currents."""
        def p(r):
            return np.polynomial.polynomial.polyval(r, TRANSFER) / TRANSFER.sum()
        dipole = self.supply["dipole"] / NOMINAL["dipole"]
        h, v = (p(self.supply[k] / NOMINAL[k]) / dipole for k in ("qh", "qv"))
        return np.repeat(np.stack([h, v], 1), 24, 1) * (ring.vars * ring.k1_design())


class State:
    """The physics of a campaign frame by frame, to be changed by effects before it is tracked."""

    def __init__(self, ring, plan):
        self.ring, self.plan = ring.copy(), plan
        n = plan.frames
        self.gradient_factor = np.ones((n, 48))
        self.current = plan.current.copy()                   # what really flows in the correctors
        self.gain = np.zeros(48)                             # of the correctors
        self.even = np.zeros(48)
        self.corrector_roll = np.zeros(48)
        self.corrector_link = []                             # (from, to, share): one corrector also drives another
        self.slot_kick = np.zeros((n, 12, 2))
        self.slot_on = np.ones((n, 12))
        self.delta = np.zeros(n)
        self.frequency_share = 0.0                           # of a fixed RF frequency, or a radial loop
        self.loop_share = 0.0
        self.readings = []                                   # functions (frames, 33) x, y -> change of what is read

    def kicks(self):
        """Kicks (frames, 48, 2) of the correctors."""
        strength = self.current * (1 + self.gain + self.even * self.current / FULL_CURRENT)
        for source, target, share in self.corrector_link:
            strength[:, target] += share * self.current[:, source]
        strength = strength * KICK_PER_AMPERE
        vertical = np.arange(48) >= 24
        c, s = np.cos(self.corrector_roll), np.sin(self.corrector_roll)
        return np.stack([strength * np.where(vertical, -s, c), strength * np.where(vertical, c, s)], -1)


class Orbits:
    """Closed orbits of all frames: ``x``, ``y`` at the 33 monitors, ``quad`` (frames, 48, 3, 2) in the quadrupoles, tunes."""

    def __init__(self, state, with_tunes=True):
        ring, plan = state.ring, state.plan
        tracker = Tracker(ring)
        gradients = plan.gradients(ring) * state.gradient_factor
        kicks = state.kicks()
        n = plan.frames
        self.x, self.y = np.zeros((n, 33)), np.zeros((n, 33))
        self.quad, self.tunes, self.delta = np.zeros((n, 48, 3, 2)), np.zeros((n, 2)), np.zeros(n)
        tracker.set(ring.vars * ring.k1_design(), np.zeros((48, 2)), np.zeros((12, 2)), np.ones(12))
        base, inside, jacobian, path = tracker.orbit(np.zeros(5))
        tunes(jacobian)
        held = inside[0, tracker.at_monitors[tracker.loop]].mean()
        last = {}
        for f in range(n):
            tracker.set(gradients[f], kicks[f], state.slot_kick[f], state.slot_on[f])
            key = (plan.corrector[f] if plan.setting[f] else "", plan.setting[f], plan.drf[f])
            guess = last.get(key, base)
            options = dict(exact_jacobian=with_tunes or key not in last, jacobian=jacobian)
            free = 0.0
            if plan.drf[f]:
                z, inside, jacobian, _ = tracker.orbit(guess, ("frequency", plan.drf[f], path), **options)
                free, guess = z[4], z
                options.update(exact_jacobian=False, jacobian=jacobian)
            if state.frequency_share and not plan.drf[f]:
                z, *_ = tracker.orbit(guess, ("frequency", 0.0, path), True)
                free, guess = state.frequency_share * z[4], z
            if state.loop_share:
                z, *_ = tracker.orbit(guess, ("loop", held), True)
                free, guess = (1 - state.loop_share) * free + state.loop_share * z[4], z
            z, inside, jacobian, _ = tracker.orbit(guess, ("momentum", free + state.delta[f]), **options)
            self.x[f], self.y[f] = inside[0, tracker.at_monitors], inside[2, tracker.at_monitors]
            self.quad[f] = inside[[0, 2]][:, tracker.at_quads].transpose(1, 2, 0)
            self.delta[f] = z[4]
            if with_tunes and key not in last:               # the matrix is that of the guess: once more, from the orbit
                _, _, jacobian, _ = tracker.orbit(z, ("momentum", z[4]))
            if with_tunes:
                self.tunes[f] = tunes(jacobian)
            last[key] = z
        self.read = np.where(np.arange(33) < 15, self.x, self.y)
        for function in state.readings:
            self.read = self.read + function(self.x, self.y, self.read)


# ------------------------------------------------------------------------------------------------- effects of the contract

def slot(place):
    """Index of a free straight ``SLOT_F6``."""
    return SLOTS.index(place[-2:])


def monitor(state, place):
    """Index of a monitor ``x_D8``."""
    return state.ring.monitors.index(place)


def corrector(place):
    """Index of a corrector ``H_A4``."""
    return CELLS.index(place[-2:])


def turned(column, angle):
    """Reading error of one monitor that is rolled by ``angle``."""
    def change(x, y, read):
        out = np.zeros_like(read)
        first, second = (x, y) if column < 15 else (y, -x)
        out[:, column] = first[:, column] * (math.cos(angle) - 1) + second[:, column] * math.sin(angle)
        return out
    return change


def scaled(columns, errors):
    """Reading error of monitors with relative gain errors."""
    def change(x, y, read):
        out = np.zeros_like(read)
        out[:, columns] = read[:, columns] * errors
        return out
    return change


def apply(state, e):
    """Put one effect of the contract's table, or one of the inventions below, into a campaign."""
    kind, at_, a = e["kind"], e.get("at"), e.get("amplitude")
    ring, n = state.ring, state.plan.frames
    if kind == "bpm_gain":
        state.readings.append(scaled([monitor(state, at_)], a))
    elif kind == "corrector_gain":
        state.gain[corrector(at_)] += a
    elif kind == "bpm_roll":
        state.readings.append(turned(monitor(state, at_), a))
    elif kind == "corrector_roll":
        state.corrector_roll[corrector(at_)] += a
    elif kind == "quad_roll":
        ring.roll[CELLS.index(at_)] += a
    elif kind == "bpm_cubic":
        m = monitor(state, at_)

        def cubic(x, y, read):
            out = np.zeros_like(read)
            out[:, m] = a * 1e6 * (x if m < 15 else y)[:, m] ** 3
            return out
        state.readings.append(cubic)
    elif kind == "bpm_swap":
        i, j = (monitor(state, p) for p in at_.split(","))

        def swap(x, y, read):
            out = np.zeros_like(read)
            out[:, i], out[:, j] = read[:, j] - read[:, i], read[:, i] - read[:, j]
            return out
        state.readings.append(swap)
    elif kind == "corrector_polarity":
        state.gain[corrector(at_)] = -2.0 - state.gain[corrector(at_)]
    elif kind == "corrector_even":
        state.even[corrector(at_)] += a
    elif kind == "stray_gradient":
        ring.slot_normal[slot(at_), 1] += a
    elif kind == "stray_skew_gradient":
        ring.slot_skew[slot(at_), 1] += a
    elif kind == "dipole_gradient":
        ring.dipole_k1l[ring.dipoles.index(at_)] += a
    elif kind == "dipole_edge":
        ring.dipole_edge[ring.dipoles.index(at_) if at_ else slice(None)] += a
    elif kind == "sextupole_error":
        ring.sextupole_k2l[CELLS.index(at_[-2:])] += a
    elif kind == "momentum_offset":
        state.delta += a
    elif kind == "fixed_rf_frequency":
        state.frequency_share = 1.0 if a is None else a
    elif kind == "radial_loop":
        state.loop_share = 1.0 if a is None else a
    elif kind == "quad_drift":
        state.gradient_factor *= 1 + a * np.linspace(-1, 1, n)[:, None]
    else:
        invented(state, e)


# ------------------------------------------------------------------------------------------- effects of nobody's table

INVENTED = {
    "stray_octupole": "thin octupole in a free straight, K3L [1/m3]",
    "skew_sextupole": "thin skew sextupole in a free straight, K2sL [1/m2]",
    "sextupole_family": "all sextupoles of one plane are on (at: SH or SV), K2L [1/m2]",
    "quad_sextupole": "sextupole component in one quadrupole, K2L [1/m2]",
    "solenoid": "solenoid in a free straight: rotation [rad] and the focusing of 1 m length",
    "cavity_focusing": "thin lens that defocuses both planes alike in a free straight [1/m]",
    "stale_monitor": "reading is mixed with the previous frame's, amplitude its share [1]",
    "monitor_crosstalk": "the first monitor also reads a share of the second [1]",
    "kick_switch": "an unrecorded kick [rad] in a free straight from `frame` on (plane x or y)",
    "pulsed_leak": "an unrecorded kick [rad] in a free straight in every second cycle (plane x or y)",
    "corrector_lag": "in the first frame after a change a corrector has made only 1 - a of it",
    "corrector_crosstalk": "the first corrector's supply also drives the second, share [1]",
    "corrector_swap": "cables of two correctors exchanged",
    "crate_drift": "offsets of five neighbouring monitors (named by the first) warm up by the amplitude [mm]",
    "family_ripple": "a family's (at: QH or QV) unrecorded sinusoidal ripple, relative amplitude, period 17.3 frames",
    "intensity_gain": "readings of a plane scale with an unrecorded beam intensity that scatters by 20 %: gain error a per unit intensity",
    "intensity_offset": "offsets of one monitor move with the unrecorded beam intensity [mm per unit intensity]",
    "monitor_clip": "a monitor cannot read further than the amplitude [mm] from its mean",
    "monitor_step": "one monitor's offset changes by the amplitude [mm] at `frame`",
    "gain_drift": "one monitor's gain drifts from 0 to the amplitude over the run [1]",
    "quad_switch": "one quadrupole changes by the amplitude [1] at `frame`",
    "skew_switch": "a skew gradient K1sL [1/m] in a free straight is on only from `frame` on",
    "momentum_wander": "slow sinusoidal momentum error of the beam, dp/p amplitude, period 41 frames",
    "coarse_adc": "a monitor's readings are multiples of the amplitude [mm]",
}


def invented(state, e):
    """Effects that no library of candidate effects was told about."""
    kind, at_, a = e["kind"], e.get("at"), e.get("amplitude")
    ring, n = state.ring, state.plan.frames
    frame = np.arange(n)
    if kind == "stray_octupole":
        ring.slot_normal[slot(at_), 3] += a
    elif kind == "skew_sextupole":
        ring.slot_skew[slot(at_), 2] += a
    elif kind == "sextupole_family":
        ring.sextupole_k2l[slice(0, 24) if at_ == "SH" else slice(24, 48)] += a
    elif kind == "quad_sextupole":
        ring.quad_k2l[CELLS.index(at_)] += a
    elif kind == "solenoid":
        c, s = math.cos(a), math.sin(a)
        turn = np.kron(np.array([[c, s], [-s, c]]), np.eye(2))
        lens = np.eye(4)
        lens[1, 0] = lens[3, 2] = -a * a
        ring.slot_matrix[slot(at_)] = turn @ lens
    elif kind == "cavity_focusing":
        lens = np.eye(4)
        lens[1, 0] = lens[3, 2] = a
        ring.slot_matrix[slot(at_)] = lens
    elif kind == "stale_monitor":
        m = monitor(state, at_)

        def stale(x, y, read):
            out = np.zeros_like(read)
            out[1:, m] = a * (read[:-1, m] - read[1:, m])
            return out
        state.readings.append(stale)
    elif kind == "monitor_crosstalk":
        i, j = (monitor(state, p) for p in at_.split(","))

        def talk(x, y, read):
            out = np.zeros_like(read)
            out[:, i] = a * read[:, j]
            return out
        state.readings.append(talk)
    elif kind == "kick_switch":
        state.slot_kick[frame >= e["frame"], slot(at_), "xy".index(e["plane"])] += a
    elif kind == "pulsed_leak":
        state.slot_kick[frame % 2 == 1, slot(at_), "xy".index(e["plane"])] += a
    elif kind == "corrector_lag":
        i = corrector(at_)
        before = np.append(0.0, state.current[:-1, i])
        step = state.current[:, i] - before
        state.current[:, i] -= np.where(np.abs(step) > 5, a * step, 0.0)
    elif kind == "corrector_crosstalk":
        i, j = (corrector(p) for p in at_.split(","))
        state.corrector_link.append((i, j, a))
    elif kind == "corrector_swap":
        i, j = (corrector(p) for p in at_.split(","))
        state.current[:, [i, j]] = state.current[:, [j, i]]
    elif kind == "crate_drift":
        m = monitor(state, at_)
        state.readings.append(lambda x, y, read: 1e-3 * a * (1 - np.exp(-frame / 120.0))[:, None]
                              * ((np.arange(33) >= m) & (np.arange(33) < m + 5)))
    elif kind == "family_ripple":
        state.gradient_factor[:, slice(0, 24) if at_ == "QH" else slice(24, 48)] *= 1 + a * np.sin(2 * np.pi * frame / 17.3)[:, None]
    elif kind == "intensity_gain":
        intensity = 0.2 * np.random.default_rng(e["seed"]).standard_normal(n)
        columns = np.arange(15) if at_ == "x" else np.arange(15, 33)
        state.readings.append(scaled(columns, a * intensity[:, None]))
    elif kind == "intensity_offset":
        intensity = 0.2 * np.random.default_rng(e["seed"]).standard_normal(n)
        m = monitor(state, at_)
        state.readings.append(lambda x, y, read: 1e-3 * a * intensity[:, None] * (np.arange(33) == m))
    elif kind == "monitor_clip":
        m = monitor(state, at_)

        def clip(x, y, read):
            out = np.zeros_like(read)
            centre = read[:, m].mean()
            out[:, m] = np.clip(read[:, m] - centre, -1e-3 * a, 1e-3 * a) + centre - read[:, m]
            return out
        state.readings.append(clip)
    elif kind == "monitor_step":
        m = monitor(state, at_)
        state.readings.append(lambda x, y, read: 1e-3 * a * (frame >= e["frame"])[:, None] * (np.arange(33) == m))
    elif kind == "gain_drift":
        state.readings.append(scaled([monitor(state, at_)], (a * frame / (n - 1))[:, None]))
    elif kind == "quad_switch":
        state.gradient_factor[frame >= e["frame"], CELLS.index(at_)] *= 1 + a
    elif kind == "skew_switch":
        ring.slot_skew[slot(at_), 1] += a
        state.slot_on[frame < e["frame"], slot(at_)] = 0.0
    elif kind == "momentum_wander":
        state.delta += a * np.sin(2 * np.pi * frame / 41.0 + 0.7)
    elif kind == "coarse_adc":
        m = monitor(state, at_)

        def coarse(x, y, read):
            out = np.zeros_like(read)
            out[:, m] = 1e-3 * a * np.round(read[:, m] / (1e-3 * a)) - read[:, m]
            return out
        state.readings.append(coarse)
    else:
        raise ValueError(f"no such effect: {kind}")


# ------------------------------------------------------------------------------------------------ an ordinary machine

def ordinary_physics(state, o, rng):
    """Ordinary imperfections of the machine itself: scatter of gains and rolls, dipoles, momentum jitter, hysteresis."""
    ring, plan = state.ring, state.plan
    gains = o.get("bpm_gain_rms", 0.0) * rng.standard_normal(33)
    gains[:15] += o.get("bpm_gain_x", 0.0)
    gains[15:] += o.get("bpm_gain_y", 0.0)
    state.gain += o.get("corrector_gain_rms", 0.0) * rng.standard_normal(48) + o.get("corrector_gain_all", 0.0)
    state.corrector_roll += o.get("corrector_roll_rms", 0.0) * rng.standard_normal(48)
    ring.roll += o.get("quad_roll_rms", 0.0) * rng.standard_normal(48)
    rolls = o.get("bpm_roll_rms", 0.0) * rng.standard_normal(33)
    for m in np.nonzero(rolls)[0]:
        state.readings.append(turned(m, rolls[m]))
    if np.any(gains):
        state.readings.append(scaled(np.arange(33), gains))
    ring.dipole_k1l += o.get("dipole_k1l", 0.0)
    ring.dipole_k2l += o.get("dipole_k2l", 0.0)
    state.delta += o.get("momentum_jitter", 0.0) * rng.standard_normal(plan.frames)
    if o.get("hysteresis"):
        remembered = np.zeros(48)
        for f in range(plan.frames):
            strong = np.abs(plan.current[f]) > 5
            remembered[strong] = plan.current[f, strong]
            state.current[f, ~strong] += o["hysteresis"] * remembered[~strong]


def ordinary_noise(o, frames, rng):
    """Noise of the readings (frames, 33) [m] with the ordinary imperfections of the electronics."""
    def draw(shape):
        if o.get("tails"):
            return rng.standard_t(4, shape) / math.sqrt(2.0)
        return rng.standard_normal(shape)
    slow, crate = o.get("slow", 0.0), o.get("crate", 0.0)
    noise = math.sqrt(max(0.0, 1 - slow - crate)) * draw((frames, 33))
    if slow:
        series = np.zeros((frames, 33))
        series[0] = rng.standard_normal(33)
        for f in range(1, frames):
            series[f] = 0.9 * series[f - 1] + math.sqrt(1 - 0.81) * rng.standard_normal(33)
        noise += math.sqrt(slow) * series
    if crate:
        group = np.concatenate([np.arange(15) // 5, 3 + np.arange(18) // 5])
        noise += math.sqrt(crate) * rng.standard_normal((frames, 7))[:, group]
    noise *= o.get("noise", 1.0) * SIGMA
    noise += np.cumsum(o.get("walk", 0.0) * rng.standard_normal((frames, 33)), 0)
    return noise


def known_faults(monitors, frames, rng):
    """Trouble that the operators know: one monitor is four times noisier and jumps, another jumps now and then [m]."""
    out = np.zeros((frames, 33))
    noisy, jumping = monitors.index(NOISY_MONITOR), monitors.index(JUMPING_MONITOR)
    out[:, noisy] = SIGMA * math.sqrt(15.0) * rng.standard_normal(frames)
    out[:, [noisy, jumping]] += np.where(rng.random((frames, 2)) < 0.03, 5e-3 * rng.standard_normal((frames, 2)), 0.0)
    return out


# ---------------------------------------------------------------------------------------------------------------- gains

class Fit:
    """What 48 vars and a free baseline for every monitor, free to move with the three supplies, can do about a signal."""

    def __init__(self, ring, plan):
        self.ring, self.plan = ring, plan
        deviations = [plan.supply[k] / NOMINAL[k] - 1 for k in ("dipole", "qh", "qv")]
        self.followed = np.stack([np.ones(plan.frames)] + deviations, 1)
        self.used = np.array([m != NOISY_MONITOR for m in ring.monitors])
        self.clean = Orbits(State(ring, plan), with_tunes=False)

    def project(self, signal, frames):
        """What the baselines cannot follow of a signal (frames, 33, ...), in units of the noise."""
        basis, _ = np.linalg.qr(self.followed[frames])
        flat = signal[frames].reshape(len(basis), -1)
        flat = flat - basis @ (basis.T @ flat)
        return (flat.reshape(signal[frames].shape) / SIGMA)[:, self.used]

    def var_signatures(self, orbits, ring):
        """Change of the readings with each ln var (frames, 33, 48), first order, from Green's functions of the ring."""
        green, k1l = greens_functions(ring)
        simpson = np.array([1.0, 4.0, 1.0]) / 6.0
        out = np.empty((self.plan.frames, 33, 48))
        for columns, plane, direction in ((slice(0, 15), 0, -1.0), (slice(15, 33), 1, 1.0)):
            kicks = (orbits.quad[..., plane] - ring.shift[:, None, plane]) * simpson * (direction * k1l[:, None])
            for q in range(48):
                out[:, columns, q] = kicks[:, q] @ green[plane][:, q].T
        return out

    def lowest(self, rest, signatures, theta, frames):
        """Lowest minus ln posterior, linear from vars moved by ``theta`` where ``rest`` is left; and the vars' move to it."""
        truth = np.log(self.ring.vars)
        jacobian = self.project(signatures, frames).reshape(-1, 48)
        rest = self.project(rest, frames).ravel()
        here = 0.5 * rest @ rest + 0.5 * np.sum((truth + theta) ** 2) / PRIOR ** 2
        slope = jacobian.T @ rest - (truth + theta) / PRIOR ** 2
        move = np.linalg.solve(jacobian.T @ jacobian + np.eye(48) / PRIOR ** 2, slope)
        return here - 0.5 * slope @ move, here, move

    def gain(self, read):
        """Gain in ln posterior of the true effect over the best fit without it, for noise-free readings (frames, 33).

        Returns it for all frames, and without the frames of moved RF frequency.
        """
        subsets = np.arange(self.plan.frames), np.nonzero(self.plan.drf == 0)[0]
        theta, orbits, ring = np.zeros(48), self.clean, self.ring
        signatures = self.var_signatures(orbits, ring)
        with_effect = [self.lowest(np.zeros_like(read), signatures, theta, frames)[0] for frames in subsets]
        best = None
        for step in range(2):
            rest = read - orbits.read
            bottom, here, move = self.lowest(rest, signatures, theta, subsets[0])
            if best is not None and here > best[0]:          # the last step overshot
                break
            best = here, bottom, self.lowest(rest, signatures, theta, subsets[1])[0]
            if np.max(np.abs(move)) < 0.01 or step == 1:
                break
            theta = np.clip(theta + move, -0.3, 0.3)
            ring = self.ring.copy()
            ring.vars = self.ring.vars * np.exp(theta)
            try:
                orbits = Orbits(State(ring, self.plan), with_tunes=False)
            except RuntimeError:                             # the fit ran out of the stable region: keep the last answer
                break
            signatures = self.var_signatures(orbits, ring)
        return round(float(best[1] - with_effect[0]), 2), round(float(best[2] - with_effect[1]), 2)


def greens_functions(ring):
    """Orbit at the 33 monitors for a kick at entrance, centre and exit of every quadrupole, x and y; and all K1L."""
    bare = Ring(ring.machine, ring.vars)
    tracker = Tracker(bare)
    tracker.set(bare.vars * bare.k1_design(), np.zeros((48, 2)), np.zeros((12, 2)), np.ones(12))
    step = 1e-6
    start = np.zeros((6, 8))
    for k in range(4):
        start[k, 2 * k], start[k, 2 * k + 1] = step, -step
    out = tracker.turn(start, np.append(tracker.points, tracker.end))
    columns = (out[:4, 0::2] - out[:4, 1::2]) / (2 * step)   # (row, column, point)
    result = []
    for plane, at_monitors, rows in ((0, tracker.at_monitors[:15], slice(0, 2)), (1, tracker.at_monitors[15:], slice(2, 4))):
        m = columns[rows, rows].transpose(2, 0, 1)           # start -> point
        turn = m[-1]
        kick = np.linalg.solve(m[tracker.at_quads], np.broadcast_to([[0.0], [1.0]], (48, 3, 2, 1)))   # as if made at the start
        closed = np.linalg.solve(np.eye(2) - turn, np.eye(2))
        before = closed @ turn @ kick                        # start of the closed orbit
        first = m[at_monitors][:, 0, :]                      # (monitor, 2)
        at_start = np.einsum("mi,qki->mqk", first, before[..., 0])
        later = np.einsum("mi,qki->mqk", first, (before + kick)[..., 0])
        downstream = tracker.points[at_monitors][:, None, None] > tracker.points[tracker.at_quads][None]
        result.append(np.where(downstream, later, at_start))
    lengths = np.array([next(e["length"] for e in ring.machine["elements"] if e["type"] == "quadrupole" and e["name"].endswith(c))
                        for c in CELLS])
    return result, ring.vars * ring.k1_design() * lengths


# ------------------------------------------------------------------------------------------------------------- recordings

def draw_ring(machine, rng):
    """Vars from the 3 % prior cut at 6 %, both tunes within 0.05 of the design; quadrupoles misaligned to an orbit of 1 to 3 mm."""
    for _ in range(10000):
        values = np.exp(PRIOR * rng.standard_normal(48))
        while np.any(bad := np.abs(values - 1) > 0.06):
            values[bad] = np.exp(PRIOR * rng.standard_normal(bad.sum()))
        ring = Ring(machine, values)
        try:
            tracker = Tracker(ring)
            tracker.set(values * ring.k1_design(), np.zeros((48, 2)), np.zeros((12, 2)), np.ones(12))
            _, _, matrix, _ = tracker.orbit(np.zeros(5))
            q = tunes(matrix)
        except RuntimeError:
            continue
        if abs(q[0] - 0.83) < 0.05 and abs(q[1] - 0.665) < 0.05:
            break
    else:
        raise RuntimeError("no machine with these tunes")
    shift = rng.standard_normal((48, 2)).clip(-2.5, 2.5)
    wanted = rng.uniform(1e-3, 3e-3, 2)
    ring.shift = 0.1e-3 * shift
    tracker = Tracker(ring)
    tracker.set(values * ring.k1_design(), np.zeros((48, 2)), np.zeros((12, 2)), np.ones(12))
    _, inside, _, _ = tracker.orbit(np.zeros(5))
    rms = np.array([inside[0, tracker.at_monitors[:15]].std(), inside[2, tracker.at_monitors[15:]].std()])
    ring.shift = ring.shift * (wanted / rms)
    return ring


def make_campaign(machine, folder, seed, ordinary, effects, condition):
    """Simulate one campaign and write it; returns the truth."""
    rng = np.random.default_rng(seed)
    ring = draw_ring(machine, rng)
    plan = Plan(rng)
    state = State(ring, plan)
    ordinary_physics(state, ordinary, rng)
    for e in effects:
        apply(state, e)
    orbits = Orbits(state)
    near_half = min(np.abs(orbits.tunes - 0.5).min(), np.abs(orbits.tunes - 1.0).min())
    if near_half < 0.03:
        raise RuntimeError("a tune is too close to a half-integer")
    offsets = 0.7e-3 * rng.standard_normal(33)
    read = orbits.read + offsets + ordinary_noise(ordinary, plan.frames, rng) + known_faults(ring.monitors, plan.frames, rng)
    meter = orbits.tunes + 5e-4 * rng.standard_normal((plan.frames, 2))
    truth = {"seed": seed, "ordinary": ordinary, "effects": effects, "vars": dict(zip(CELLS, map(float, ring.vars))),
             "condition": condition}
    if effects:
        fit = Fit(ring, plan)

        def alone(some):
            ideal = State(ring, plan)
            for e in some:
                apply(ideal, e)
            return fit.gain(Orbits(ideal, with_tunes=False).read)
        own = [alone([e]) for e in effects]
        all_together = own[0] if len(own) == 1 else alone(effects)
        truth["own_gain"] = [g[0] for g in own]
        truth["oracle_gain"] = truth["ideal_gain"] = all_together[0]
        truth["own_gain_without_rf_frames"] = [g[1] for g in own]
        truth["oracle_gain_without_rf_frames"] = all_together[1]
    truth["orbit_rms_mm"] = [round(float(1e3 * orbits.x.mean(0)[:15].std()), 2), round(float(1e3 * orbits.y.mean(0)[15:].std()), 2)]
    truth["tunes"] = [round(float(v), 4) for v in orbits.tunes.mean(0)]
    write(folder, plan, ring, read, meter, truth)
    return truth


def write(folder, plan, ring, read, meter, truth):
    """Write header, frames and truth of one campaign."""
    os.makedirs(folder, exist_ok=True)
    with open(os.path.join(folder, "header.toml"), "w") as f:
        f.write(HEADER)
    names = (["seq", "time_s", "t_cycle_ms", "corrector", "setting_A", "drf_rel", "i_dipole_A", "i_qh_A", "i_qv_A", "i_sh_A", "i_sv_A"]
             + [f"ic_{c}_A" for c in CELLS] + [m + "_mm" for m in ring.monitors] + ["qx_frac", "qy_frac"])
    with open(os.path.join(folder, "frames.csv"), "w") as f:
        f.write(",".join(names) + "\n")
        for i in range(plan.frames):
            row = [str(i), f"{4.0 * i:.3f}", "92.0", plan.corrector[i], f"{plan.setting[i]:.0f}", f"{plan.drf[i]:g}"]
            row += [f"{plan.read_back[k][i]:.3f}" for k in ("dipole", "qh", "qv")]
            row += [f"{v:.5g}" for v in plan.sextupole_current[i]]
            row += [f"{v:.4f}" for v in plan.current[i]]
            row += [f"{1e3 * v:.4f}" for v in read[i]]
            row += [f"{v:.5f}" for v in meter[i]]
            f.write(",".join(row) + "\n")
    with open(os.path.join(folder, "truth.json"), "w") as f:
        json.dump(truth, f, indent=1)


# -------------------------------------------------------------------------------------------------------------- the sets

def sign(rng):
    """Plus or minus one."""
    return 1.0 if rng.random() < 0.5 else -1.0


CONDITIONS = ["noise", "slow", "walk", "scatter", "common", "dipoles"]


def condition_of(name, rng, k):
    """Ordinary imperfections of one condition, and what a person would call it; ``k`` counts the seeds."""
    if name == "noise":
        factor = (1.1, 1.25)[k % 2]
        return {"noise": factor}, f"noise {100 * (factor - 1):.0f} % above the header"
    if name == "slow":
        return {"slow": 0.1}, "a tenth of the noise's variance is slow"
    if name == "walk":
        w = (2e-6, 3e-6, 4e-6, 5e-6, 6e-6)[k % 5]
        return {"walk": w}, f"every monitor walks by {1e6 * w:.0f} um per root frame"
    if name == "scatter":
        return {"bpm_gain_rms": 0.02, "corrector_gain_rms": 0.02, "bpm_roll_rms": 0.01, "corrector_roll_rms": 0.01,
                "quad_roll_rms": 0.001}, "every gain and roll off by a little"
    if name == "common":
        a, b = 0.03 * sign(rng), 0.03 * sign(rng)
        return {"bpm_gain_x": a, "bpm_gain_y": a, "corrector_gain_all": b}, "all correctors and all monitors off by 3 %"
    if name == "dipoles":
        k1l = 2e-3 * (1.0 if k % 2 else -1.0)
        k2l = rounded(rng.uniform(0.05, 0.15))
        return {"dipole_k1l": k1l, "dipole_k2l": k2l}, "a gradient and an eddy-current sextupole in all dipoles"
    if name == "tails":
        return {"tails": 1}, "noise with Student tails"
    if name == "jitter":
        return {"momentum_jitter": float(rng.choice([2e-5, 4e-5]))}, "the momentum jitters"
    if name == "crate":
        return {"crate": float(rng.choice([0.1, 0.2]))}, "part of the noise is common to a crate"
    if name == "hysteresis":
        return {"hysteresis": float(rng.choice([0.003, 0.006]))}, "correctors remember"
    if name == "many":
        return {"noise": 1.1, "slow": 0.1, "tails": 1, "walk": 2e-6, "bpm_gain_rms": 0.01, "corrector_gain_rms": 0.01,
                "bpm_roll_rms": 0.005, "corrector_roll_rms": 0.005, "quad_roll_rms": 0.0005, "dipole_k1l": 1e-3 * sign(rng),
                "momentum_jitter": 2e-5}, "noise, slow noise, tails, walk, scatter, dipoles, momentum jitter at once"
    return {}, "nothing imperfect"


class Places:
    """Random places of each sort, only where a recording can show anything."""

    def __init__(self, machine, rng):
        self.rng = rng
        data = machine["data"]
        self.monitors = [m for m in ["x_" + c for c in data["bpm_x"]] + ["y_" + c for c in data["bpm_y"]]
                         if m not in (NOISY_MONITOR, JUMPING_MONITOR)]
        self.correctors = (["H_" + c for c in H_CELLS if c not in ("D6",)]
                           + ["V_" + c for c in V_CELLS if c not in data["no_corrector_data_V"]])
        self.both_signs = [c for c in self.correctors if c not in ("H_C6", "V_A1", "V_E3", "V_E7")]
        self.dipoles = [e["name"] for e in machine["elements"] if e["type"] == "sbend"]

    def pick(self, names):
        """One of ``names``."""
        return str(names[self.rng.integers(len(names))])

    def slot(self):
        """One free straight."""
        return "SLOT_" + self.pick(SLOTS)

    def pair(self, names):
        """Two different names of the same plane."""
        first = self.pick(names)
        return first + "," + self.pick([n for n in names if n[0] == first[0] and n != first])


def rounded(value):
    """Three significant digits."""
    return float(f"{value:.3g}")


WIDTH = {"bpm_gain": 0.08, "corrector_gain": 0.08, "bpm_roll": 0.01, "corrector_roll": 0.01, "quad_roll": 0.005, "bpm_cubic": 2e-4,
         "corrector_even": 0.03, "stray_gradient": 0.01, "stray_skew_gradient": 0.01, "dipole_gradient": 0.01, "dipole_edge": 0.02,
         "sextupole_error": 2.0, "momentum_offset": 0.002, "quad_drift": 0.001}
KINDS = list(WIDTH) + ["fixed_rf_frequency", "radial_loop", "bpm_swap", "corrector_polarity"]


def table_effect(kind, places, low=0.5, high=2.5):
    """One effect of the contract's table at a random place, ``low`` to ``high`` prior widths strong."""
    rng = places.rng
    e = {"kind": kind}
    if kind in ("bpm_gain", "bpm_roll", "bpm_cubic"):
        e["at"] = places.pick(places.monitors)
    elif kind in ("corrector_gain", "corrector_roll", "corrector_polarity"):
        e["at"] = places.pick(places.correctors)
    elif kind == "corrector_even":
        e["at"] = places.pick(places.both_signs)
    elif kind == "quad_roll":
        e["at"] = places.pick(CELLS)
    elif kind in ("stray_gradient", "stray_skew_gradient"):
        e["at"] = places.slot()
    elif kind in ("dipole_gradient", "dipole_edge"):
        e["at"] = places.pick(places.dipoles)
    elif kind == "sextupole_error":
        e["at"] = "SX_" + places.pick(CELLS)
    elif kind == "bpm_swap":
        e["at"] = places.pair(places.monitors)
    if kind in WIDTH:
        e["amplitude"] = rounded(sign(rng) * WIDTH[kind] * rng.uniform(low, high))
    elif kind in ("fixed_rf_frequency", "radial_loop"):
        e["amplitude"] = rounded(rng.uniform(0.4, 1.0))
    return e


INVENTED_SIZES = {                            # weak, strong
    "stray_octupole": (150.0, 1500.0), "skew_sextupole": (0.7, 4.0), "sextupole_family": (0.05, 0.2), "quad_sextupole": (1.0, 5.0),
    "solenoid": (0.006, 0.03), "cavity_focusing": (0.004, 0.02), "stale_monitor": (0.05, 0.5), "monitor_crosstalk": (0.05, 0.25),
    "kick_switch": (6e-6, 4e-5), "pulsed_leak": (4e-6, 2e-5), "corrector_lag": (0.1, 0.4), "corrector_crosstalk": (0.03, 0.15),
    "corrector_swap": (None, None), "crate_drift": (0.06, 0.3), "family_ripple": (5e-4, 2e-3), "intensity_gain": (0.05, 0.3),
    "intensity_offset": (0.3, 1.5), "monitor_clip": (1.6, 0.8), "monitor_step": (0.08, 0.5), "gain_drift": (0.08, 0.3),
    "quad_switch": (0.003, 0.02), "skew_switch": (0.003, 0.015), "momentum_wander": (2e-5, 1.2e-4), "coarse_adc": (0.4, 1.2)}


def invented_effect(kind, places, strength):
    """One invented effect, ``strength`` from 0 (weak) to 1 (strong) on a logarithmic scale."""
    rng = places.rng
    e = {"kind": kind}
    if kind in ("stray_octupole", "skew_sextupole", "solenoid", "cavity_focusing", "kick_switch", "pulsed_leak", "skew_switch"):
        e["at"] = "SLOT_A3" if kind == "cavity_focusing" else places.slot()
    elif kind == "sextupole_family":
        e["at"] = places.pick(["SH", "SV"])
    elif kind == "family_ripple":
        e["at"] = places.pick(["QH", "QV"])
    elif kind == "intensity_gain":
        e["at"] = places.pick(["x", "y"])
    elif kind in ("quad_sextupole", "quad_switch"):
        e["at"] = places.pick(CELLS)
    elif kind in ("stale_monitor", "intensity_offset", "monitor_clip", "monitor_step", "gain_drift", "coarse_adc"):
        e["at"] = places.pick(places.monitors)
    elif kind == "crate_drift":
        e["at"] = places.pick([m for m in places.monitors if m in ("x_A6", "x_B4", "x_E2", "y_A1", "y_C1", "y_E5")])
    elif kind == "monitor_crosstalk":
        e["at"] = places.pair(places.monitors)
    elif kind in ("corrector_crosstalk", "corrector_swap"):
        e["at"] = places.pair(places.correctors)
    elif kind == "corrector_lag":
        e["at"] = places.pick(places.both_signs)
    weak, strong = INVENTED_SIZES[kind]
    if weak is not None:
        size = weak * (strong / weak) ** strength
        one_signed = ("stale_monitor", "corrector_lag", "monitor_clip", "coarse_adc", "family_ripple", "momentum_wander")
        e["amplitude"] = rounded(size if kind in one_signed else size * sign(rng))
    if kind in ("kick_switch", "pulsed_leak"):
        e["plane"] = places.pick(["x", "y"])
    if kind in ("kick_switch", "monitor_step", "quad_switch", "skew_switch"):
        e["frame"] = int(rng.integers(70, 280))
    if kind.startswith("intensity"):
        e["seed"] = int(rng.integers(1 << 30))
    return e


def specifications(name, machine):
    """The campaigns of one set: (seed, ordinary, effects, condition)."""
    number = {"empty": 1, "single": 2, "kinds": 3, "several": 4, "unknown": 5}[name]
    rng = np.random.default_rng(770000 + number)
    places = Places(machine, rng)
    rows = []
    if name == "empty":
        for c in CONDITIONS:
            for k in range(10):
                rows.append((*condition_of(c, rng, k), []))
        for c in ["tails", "tails", "jitter", "jitter", "crate", "crate", "hysteresis", "hysteresis", "many", "many", "many", "many"]:
            rows.append((*condition_of(c, rng, 0), []))
    elif name == "single":
        for c in CONDITIONS:
            for k in range(8):
                if k % 2:
                    e = {"kind": "stray_skew_gradient", "at": places.slot(), "amplitude": rounded(sign(rng) * rng.uniform(0.010, 0.014))}
                else:
                    e = {"kind": "bpm_gain", "at": places.pick(places.monitors), "amplitude": rounded(sign(rng) * rng.uniform(0.10, 0.14))}
                rows.append((*condition_of(c, rng, k // 2), [e]))
    elif name == "kinds":
        mild = [({}, "nothing imperfect"), ({"noise": 1.05}, "noise 5 % above the header"),
                ({"bpm_gain_rms": 0.005, "corrector_gain_rms": 0.005, "bpm_roll_rms": 0.003, "corrector_roll_rms": 0.003,
                  "quad_roll_rms": 0.0003}, "every gain and roll off by very little"), ({"walk": 1e-6}, "monitors walk a little")]
        for k in range(40):
            kind = KINDS[k % 18] if k < 36 else ["dipole_edge", "stray_gradient", "bpm_gain", "corrector_roll"][k - 36]
            e = table_effect(kind, places)
            if k == 36:
                e = {"kind": "dipole_edge", "amplitude": rounded(sign(rng) * rng.uniform(0.006, 0.014))}
            rows.append((*mild[0 if k % 2 else (k // 2) % 4], [e]))
    elif name == "several":
        strong = ["bpm_gain", "corrector_gain", "quad_roll", "stray_skew_gradient", "corrector_polarity", "bpm_swap", "corrector_even",
                  "fixed_rf_frequency", "quad_drift", "sextupole_error", "corrector_roll", "bpm_roll"]
        for k in range(20):
            n = 2 + k % 3
            picked = rng.choice(len(strong), n, replace=False)
            effects, taken = [], set()
            for p in picked:
                e = table_effect(strong[p], places, 1.5, 3.0)
                if strong[p].endswith("_roll"):
                    e["amplitude"] = rounded(e["amplitude"] * (2 if strong[p] == "quad_roll" else 4))
                cells = set(e.get("at", strong[p]).split(","))
                if cells & taken:
                    e = table_effect(strong[p], places, 1.5, 3.0)
                taken |= cells
                effects.append(e)
            rows.append((*condition_of(["none", "none", "noise", "walk"][k % 4], rng, 0), effects))
    elif name == "unknown":
        kinds = list(INVENTED)
        twice = [k for k in kinds if k not in ("corrector_swap", "cavity_focusing", "coarse_adc", "quad_sextupole", "solenoid",
                                               "monitor_clip", "intensity_offset", "sextupole_family")]
        for k, kind in enumerate(kinds):
            rows.append((*condition_of("none" if k % 3 else "noise", rng, 0), [invented_effect(kind, places, rng.uniform(0.4, 1.0))]))
        for k, kind in enumerate(twice):
            rows.append((*condition_of("none", rng, 0), [invented_effect(kind, places, rng.uniform(0.0, 0.6))]))
    return [(number * 100000 + 17 * i + 5, o, e, c) for i, (o, c, e) in enumerate(rows)]


# ----------------------------------------------------------------------------------------------------------------- checks

def response(ring, delta=0.0, fixed_frequency=False, kick=0.2e-3):
    """Response (48 monitor places x 48 correctors) of x and of y [m/rad], half difference of plus and minus ``kick``."""
    tracker = Tracker(ring)
    x, y = np.zeros((48, 48)), np.zeros((48, 48))
    tracker.set(ring.vars * ring.k1_design(), np.zeros((48, 2)), np.zeros((12, 2)), np.ones(12))
    base, _, _, path = tracker.orbit(np.zeros(5), ("momentum", delta))
    hold = ("frequency", 0.0, path) if fixed_frequency else ("momentum", delta)
    for c in range(48):
        both = []
        for s in (1, -1):
            kicks = np.zeros((48, 2))
            kicks[c, int(c >= 24)] = s * kick
            tracker.set(ring.vars * ring.k1_design(), kicks, np.zeros((12, 2)), np.ones(12))
            _, inside, _, _ = tracker.orbit(base, hold)
            both.append(inside[:, tracker.at_all_monitors])
        difference = (both[0] - both[1]) / (2 * kick)
        x[:, c], y[:, c] = difference[0], difference[2]
    return x, y


def check(machine, files):
    """Largest difference of responses and tunes from stored references of other codes."""
    for path in files:
        with open(path) as f:
            reference = json.load(f)
        for name, m in reference.get("machines", {}).items():
            ring = Ring(machine, [m["vars"][c] for c in CELLS])
            x, y = response(ring)
            tracker = Tracker(ring)
            tracker.set(ring.vars * ring.k1_design(), np.zeros((48, 2)), np.zeros((12, 2)), np.ones(12))
            q = tunes(tracker.orbit(np.zeros(5))[2])
            h, v = np.array(m["response_H_m_per_rad"]), np.array(m["response_V_m_per_rad"])
            print(f"{os.path.basename(path)} {name}: x {np.abs(x[:24, :24] - h).max():.1e}, y {np.abs(y[24:, 24:] - v).max():.1e} m/rad, "
                  f"tunes {abs(q[0] + 4 - m['qx']):.1e}, {abs(q[1] + 4 - m['qy']):.1e}")
        for name, c in reference.get("cases", {}).items():
            state = State(Ring(machine), Plan(np.random.default_rng(0)))
            for e in c["effects"]:
                e = dict(e)
                if e["kind"] == "quad_roll":
                    e["at"] = e["at"][-2:]
                apply(state, e)
            x, y = response(state.ring, float(state.delta[0]), bool(state.frequency_share))
            print(f"{os.path.basename(path)} {name}: x {np.abs(x - np.array(c['response_x_m_per_rad'])).max():.1e}, "
                  f"y {np.abs(y - np.array(c['response_y_m_per_rad'])).max():.1e} m/rad")


def main():
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--machine", required=True, help="booster.json")
    parser.add_argument("--out", help="folder for the sets")
    parser.add_argument("--set", nargs="+", default=["empty", "single", "kinds", "several", "unknown"])
    parser.add_argument("--only", nargs="+", type=int, help="numbers within a set")
    parser.add_argument("--check", nargs="+", metavar="REFERENCE", help="compare with stored responses and stop")
    options = parser.parse_args()
    with open(options.machine) as f:
        machine = json.load(f)
    if options.check:
        check(machine, options.check)
        return
    for name in options.set:
        for i, (seed, ordinary, effects, condition) in enumerate(specifications(name, machine)):
            if options.only and i not in options.only:
                continue
            start = time.time()
            for attempt in range(20):                        # another machine where this one is not stable with the effect
                try:
                    truth = make_campaign(machine, os.path.join(options.out, name, f"{name}-{i:02d}"), seed + 1000000 * attempt,
                                          ordinary, effects, condition)
                    break
                except (RuntimeError, np.linalg.LinAlgError) as problem:
                    print(f"{name}-{i:02d}: {problem}, next machine", flush=True)
            else:
                raise RuntimeError(f"{name}-{i:02d}: no stable machine")
            what = ", ".join(f"{e['kind']}@{e.get('at', '-')}={e.get('amplitude', '-')}" for e in effects) or condition
            print(f"{name}-{i:02d} {what} gain {truth.get('own_gain', '-')} orbit {truth['orbit_rms_mm']} tunes {truth['tunes']} "
                  f"{time.time() - start:.1f} s", flush=True)


if __name__ == "__main__":
    main()
