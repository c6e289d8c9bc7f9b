"""Blind orbit-response campaigns of the AGS Booster, simulated with Xsuite.

The program tracks the neutral machine description (``booster.json``) with Xsuite's exact maps, frame by frame, and writes each
campaign as a folder with ``header.toml``, ``frames.csv`` and ``truth.json``.  What was set in which frame, when, and in which columns
it is written comes from an existing recording, the template; currents, readings and tunes are new.  The program shares no code with
the program that reads the campaigns: orbits, tunes and the gains in ``truth.json`` all come from tracking with Xsuite.

    python blind_xsuite.py --machine booster.json --template RECORDING_FOLDER --out DIR [--seed N] [NAME ...]

Without names it writes all 52 campaigns: a01 to a10 are machines with ordinary imperfections only; b01 to b12 have one effect of the
diagnosis's own table in addition, c01 to c24 one that is invented, d01 to d06 two of the table.

Maps: exact drifts; ``Quadrupole`` in two halves, without fringe fields; ``Bend`` with ``bend-kick-bend`` and full edges; thin
``Multipole`` for correctors, sextupoles and the free straights; ``UniformSolenoid`` for a field along the beam.

Units: metres and radians inside, millimetres in the recordings and in the readings' imperfections.  Signs are MAD's: x outward, y up,
x' -= K1L x, y' += K1sL x.
"""
import argparse
import csv
import json
import math
import os
import re
import time
import zlib

os.environ["OMP_NUM_THREADS"] = "1"                          # five particles on one core; must be set before the imports below

import numpy as np
import xtrack as xt

SIGMA = 0.15                                 # a reading's noise [mm]
KICK_PER_AMPERE = 0.00909091e-3              # [rad/A], as in the header
NOMINAL = np.array([2400.0, 1800.0, 1790.0])  # currents of dipoles, horizontal and vertical quadrupoles [A]
TRANSFER = [0.0016, 1.0121, -0.0021, -0.0052, -0.0049, -0.0015]
KINETIC_ENERGY = 1.5e9                       # [eV]
SLIP = -0.1064363867318566                   # slip factor of the design ring, below transition
DIPOLE_TO_MOMENTUM = -1.391                  # momentum offset per relative dipole field at fixed frequency, 1 / (gamma^2 slip)
PRIOR = 0.03                                 # standard deviation of ln var
SUPPLY_RIPPLE = 1.95e-4                      # relative, of the three supplies
SUPPLY_READ_BACK = 3e-5                      # noise of their read-back, relative
CORRECTOR_READ_BACK = 0.019                  # [A]
TUNE_NOISE = 0.0012
POLE_RADIUS = 0.083                          # of the quadrupoles [m]
STEP = 1e-5                                  # for derivatives of the one-turn map [m, rad]
SOLENOID_SLOT = "SLOT_C6"                    # the free straight that can hold a solenoid of 1 m


# ------------------------------------------------------------------------------------------------------------ the campaign

class Plan:
    """What the template recording says was set, frame by frame, and the names of what was set and read."""

    def __init__(self, machine, template):
        self.machine = machine
        with open(os.path.join(template, "header.toml")) as f:
            self.header = re.sub(r'recorded_with = ".*"', f'recorded_with = "Xsuite, xtrack {xt.__version__}, exact maps"', f.read())
        with open(os.path.join(template, "frames.csv")) as f:
            self.columns, *self.rows = csv.reader(f)
        self.frames = len(self.rows)
        self.cells = [c[3:-2] for c in self.columns if c.startswith("ic_")]         # of the correctors: 24 horizontal, 24 vertical
        self.horizontal = np.arange(48) < 24
        self.correctors = [("H_" if h else "V_") + c for h, c in zip(self.horizontal, self.cells)]
        self.monitors = [c[:-3] for c in self.columns if c.endswith("_mm")]
        self.reads_x = np.array([m[0] == "x" for m in self.monitors])
        self.name_magnets()
        self.settings = [(row[3], float(row[4]), float(row[5])) for row in self.rows]   # corrector, setting [A], relative RF step
        self.drf = np.array([s[2] for s in self.settings])
        self.follow_correctors()

    def name_magnets(self):
        """Names of the magnets; quadrupoles in the order of the vars, with their design gradients and lengths."""
        elements = self.machine["elements"]
        quads = [e for e in elements if e["type"] == "quadrupole"]
        quads = [e for e in quads if e["family"] == "QH"] + [e for e in quads if e["family"] == "QV"]
        self.quads = [e["name"] for e in quads]
        self.quad_cells = [name[3:] for name in self.quads]
        self.quad_k1 = np.array([self.machine["k1"][e["family"]] for e in quads])
        self.quad_length = np.array([e["length"] for e in quads])
        self.dipoles = [e["name"] for e in elements if e["type"] == "sbend"]
        self.sextupoles = [e["name"] for e in elements if e["type"] == "sextupole"]
        self.slots = [e["name"] for e in elements if e["type"] == "marker"]

    def follow_correctors(self):
        """Setting of every corrector in every frame, the one before its last change, and the frames since that change."""
        self.current = np.zeros((self.frames, 48))
        self.previous = np.zeros((self.frames, 48))
        self.age = np.full((self.frames, 48), 1000)
        now, before, age = np.zeros(48), np.zeros(48), np.full(48, 1000)
        for f, (cell, setting, _) in enumerate(self.settings):
            new = np.zeros(48)
            if cell:
                new[self.cells.index(cell)] = setting
            changed = new != now
            before[changed] = now[changed]
            age = np.where(changed, 0, age + 1)
            now = new
            self.current[f], self.previous[f], self.age[f] = now, before, age


class Frame:
    """Everything that acts on the beam in one frame, to be changed by effects before it is tracked."""

    def __init__(self, machine, f, ripple):
        plan, ordinary = machine.plan, machine.ordinary
        self.index = f
        self.time = f / (plan.frames - 1)                    # 0 in the first frame, 1 in the last
        self.dipole_ripple = ripple[0]
        self.dipole_current, horizontal, vertical = 1 + ripple   # relative to nominal
        self.gradient_factor = machine.vars.copy()           # of the quadrupoles
        self.gradient_factor[:24] *= transfer(horizontal) / transfer(1.0) / self.dipole_current
        self.gradient_factor[24:] *= transfer(vertical) / transfer(1.0) / self.dipole_current
        self.quad_shift = machine.quad_shift.copy()
        self.quad_roll = machine.quad_roll.copy()
        self.quad_normal, self.quad_skew = np.zeros((48, 5)), np.zeros((48, 5))   # thin K(n)L in the centre, n = 0..4
        self.slot_normal, self.slot_skew = np.zeros((12, 6)), np.zeros((12, 6))   # thin K(n)L in the free straights, n = 0..5
        self.sextupole_k2l = np.zeros(48)
        self.dipole_k1l = ordinary.get("dipole_gradient_k1l", 0.0)
        self.dipole_k2l = ordinary.get("dipole_sextupole_k2l", 0.0)
        self.dipole_k1sl = 0.0
        self.solenoid = 0.0                                  # field over rigidity [1/m]
        self.current = plan.current[f] + ordinary.get("cor_remanence", 0.0) * plan.previous[f]   # what the correctors' fields follow
        self.gain = machine.corrector_gain.copy()
        self.corrector_roll = machine.corrector_roll.copy()
        self.delta = machine.jitter[f]
        self.drf = plan.drf[f]
        self.frequency_held = False
        self.correctors_on = True

    def kicks(self, horizontal):
        """Kicks (48, 2) of the correctors; a stronger dipole field means a stiffer beam."""
        if not self.correctors_on:
            return np.zeros((48, 2))
        kick = KICK_PER_AMPERE * self.current * self.gain / self.dipole_current
        c, s = np.cos(self.corrector_roll), np.sin(self.corrector_roll)
        return np.stack([np.where(horizontal, kick * c, -kick * s), np.where(horizontal, kick * s, kick * c)], 1)


def transfer(ratio):
    """Gradient of a quadrupole, but for a factor, at this ratio of its current to the nominal one."""
    return np.polyval(TRANSFER[::-1], ratio)


# ---------------------------------------------------------------------------------------------------------------- the ring

def thin(order):
    """A thin multipole without field, up to K(order - 1)L."""
    return xt.Multipole(knl=[0] * order, ksl=[0] * order)


def bend(e):
    """A sector dipole with both fringe fields, and room for field errors."""
    return xt.Bend(length=e["length"], angle=e["angle"], k0_from_h=True, k1=0.0, knl=[0] * 4, ksl=[0] * 4,
                   model="bend-kick-bend", num_multipole_kicks=3, edge_entry_model="full", edge_exit_model="full",
                   edge_entry_hgap=e["hgap"], edge_exit_hgap=e["hgap"], edge_entry_fint=e["fint"], edge_exit_fint=e["fint"])


def placed_elements(plan, with_solenoid):
    """(start, length, name, element) of everything but the drifts.  No field is on yet but that of the dipoles."""
    items = []
    for e in plan.machine["elements"]:
        name, kind, start, length = e["name"], e["type"], e["s_start"], e["length"]
        if kind == "quadrupole":                             # halves, with room for field errors in the centre
            items.append((start, length / 2, name + "_1", xt.Quadrupole(length=length / 2, k1=0.0)))
            items.append((start + length / 2, 0.0, name + "_m", thin(5)))
            items.append((start + length / 2, length / 2, name + "_2", xt.Quadrupole(length=length / 2, k1=0.0)))
        elif kind == "sbend":
            items.append((start, length, name, bend(e)))
        elif kind == "corrector":
            items.append((start, 0.0, name, thin(3)))
        elif kind == "bpm":
            if ("x_" if e["plane"] == "H" else "y_") + name[4:] in plan.monitors:
                items.append((start, 0.0, name, xt.Marker()))
        elif kind == "sextupole":
            items.append((start + length / 2, 0.0, name, thin(3)))
        elif with_solenoid and name == SOLENOID_SLOT:
            items.append((start - 0.5, 1.0, name, xt.UniformSolenoid(length=1.0, ks=0.0)))
        else:
            items.append((start, 0.0, name, thin(6)))
    return sorted(items, key=lambda item: (round(item[0], 6), item[1] > 0))   # thin elements before a long one that starts there


def build_line(plan, with_solenoid):
    """The ring as an Xsuite line."""
    elements, names, position = [], [], 0.0
    for start, length, name, element in placed_elements(plan, with_solenoid):
        if start - position < -1e-6:
            raise ValueError(f"{name} at {start} m overlaps what ends at {position} m")
        if start - position > 1e-7:
            names.append(f"drift_{len(names)}")
            elements.append(xt.Drift(length=start - position, model="exact"))
        names.append(name)
        elements.append(element)
        position = start + length
    names.append("drift_end")
    elements.append(xt.Drift(length=plan.machine["circumference_m"] - position, model="exact"))
    line = xt.Line(elements=elements, element_names=names)
    line.particle_ref = xt.Particles(mass0=xt.PROTON_MASS_EV, kinetic_energy0=KINETIC_ENERGY)
    line.build_tracker()
    return line


def five_particles():
    """Protons for an orbit and its derivatives."""
    return xt.Particles(mass0=xt.PROTON_MASS_EV, kinetic_energy0=KINETIC_ENERGY, x=np.zeros(5))


class Tracker:
    """The ring in Xsuite.  It remembers what is written in its elements, and writes only what changes from frame to frame."""

    def __init__(self, plan, with_solenoid):
        self.plan = plan
        self.line = build_line(plan, with_solenoid)
        where = {name: i for i, name in enumerate(self.line.element_names)}
        self.at_monitors = np.array([where[("PUH_" if m[0] == "x" else "PUV_") + m[2:]] for m in plan.monitors])
        self.at_quads = np.array([[where[q + "_1"], where[q + "_m"], where[q + "_2"] + 1] for q in plan.quads])   # entrance, centre, exit
        self.particles = five_particles()
        named = self.line.element_dict
        self.halves = [(named[q + "_1"], named[q + "_2"]) for q in plan.quads]
        self.quad_centres = [named[q + "_m"] for q in plan.quads]
        self.correctors = [named["DC" + name] for name in plan.correctors]
        self.dipoles = [named[name] for name in plan.dipoles]
        self.sextupoles = [named[name] for name in plan.sextupoles]
        self.slots = [named[name] for name in plan.slots]
        self.solenoid = named[SOLENOID_SLOT] if with_solenoid else None
        self.written = {}

    def update(self, what, values, put):
        """Call ``put`` with index and value for each of ``values`` that changed; in the beginning all are zero."""
        values = np.array(values, float)
        for index in np.argwhere(values != self.written.get(what, 0.0)):
            put(*index, float(values[tuple(index)]))
        self.written[what] = values

    def update_field(self, what, elements, component, values):
        """The same for values (element, n) of K(n)L, ``component`` "knl" or "ksl"."""
        def put(i, n, value):
            getattr(elements[i], component)[n] = value
        self.update(what, values, put)

    def update_halves(self, what, attribute, values):
        """The same for an attribute of the quadrupoles, which has one value for both halves."""
        def put(i, value):
            for half in self.halves[i]:
                setattr(half, attribute, value)
        self.update(what, values, put)

    def set(self, frame):
        """Write one frame."""
        self.update_halves("gradient", "k1", self.plan.quad_k1 * frame.gradient_factor)
        self.update_halves("shift x", "shift_x", frame.quad_shift[:, 0])
        self.update_halves("shift y", "shift_y", frame.quad_shift[:, 1])
        self.update_halves("roll", "rot_s_rad", frame.quad_roll)
        self.update_field("quad normal", self.quad_centres, "knl", frame.quad_normal)
        self.update_field("quad skew", self.quad_centres, "ksl", frame.quad_skew)
        self.update_field("slot normal", self.slots, "knl", frame.slot_normal)
        self.update_field("slot skew", self.slots, "ksl", frame.slot_skew)
        kicks = frame.kicks(self.plan.horizontal)
        self.update_field("kick x", self.correctors, "knl", -kicks[:, :1])   # x' -= K0L
        self.update_field("kick y", self.correctors, "ksl", kicks[:, 1:])
        self.update_field("sextupole", self.sextupoles, "knl", np.outer(frame.sextupole_k2l, [0.0, 0.0, 1.0]))
        dipoles = np.ones(len(self.dipoles))
        self.update_field("dipole normal", self.dipoles, "knl", np.outer(dipoles, [0.0, frame.dipole_k1l, frame.dipole_k2l]))
        self.update_field("dipole skew", self.dipoles, "ksl", np.outer(dipoles, [0.0, frame.dipole_k1sl]))
        if self.solenoid is not None:
            self.solenoid.ks = frame.solenoid

    def turn(self, start, delta):
        """Track (x, px, y, py) once round the ring.

        Returns the coordinates at every element's entrance and at the end (4, points), their derivatives with respect to the start
        (4, 4, points), and zeta at the end of that particle and of the four that started ``STEP`` beside it.
        """
        offsets = np.zeros((4, 5))
        offsets[:, 1:] = np.eye(4) * STEP
        p = self.particles
        p.x[:], p.px[:], p.y[:], p.py[:] = start[:, None] + offsets
        p.zeta[:] = 0
        p.state[:] = 1
        p.s[:] = 0
        p.at_element[:] = 0
        p.at_turn[:] = 0
        p.delta[:] = delta                                   # Xsuite changes the other measures of momentum with it
        self.line.track(p, num_turns=1, turn_by_turn_monitor="ONE_TURN_EBE")
        if np.any(p.state <= 0):
            self.particles = five_particles()                # Xsuite reorders lost particles and does not track them again
            raise RuntimeError("lost")
        seen = self.line.record_last_track
        inside = np.array([seen.x, seen.px, seen.y, seen.py])
        derivatives = (inside[:, 1:, :] - inside[:, :1, :]) / STEP
        return inside[:, 0, :], derivatives, seen.zeta[:, -1]

    def orbit(self, guess, delta):
        """Closed orbit at momentum offset ``delta`` near ``guess``: its start, then as in ``turn`` but zeta of the orbit only.

        The last step is linear: 0.02 mm from the closed orbit the rest is far below the readings' digits.
        """
        z = guess
        for _ in range(8):
            inside, derivatives, zeta = self.turn(z, delta)
            step = np.linalg.solve(np.eye(4) - derivatives[:, :, -1], inside[:, -1] - z)
            if not np.all(np.isfinite(step)):
                raise RuntimeError("no closed orbit")
            if np.abs(step).max() < 2e-5:
                length = zeta[0] + ((zeta[1:] - zeta[0]) / STEP) @ step
                return z + step, inside + np.einsum("ijn,j->in", derivatives, step), derivatives, length
            z = z + step
        raise RuntimeError("no closed orbit")


def tunes(matrix):
    """Fractional tunes (x, y) of a 4x4 one-turn matrix, weakly coupled: the mode with more of x is called x."""
    values, vectors = np.linalg.eig(matrix)
    if np.abs(np.abs(values) - 1).max() > 2e-4:
        raise RuntimeError("unstable")
    symplectic = np.kron(np.eye(2), [[0, 1], [-1, 0]])
    modes = []
    for value, vector in zip(values, vectors.T):
        if (1j * vector.conj() @ symplectic @ vector).real >= 0:     # of each pair the one that turns the same way
            share_of_x = np.sum(np.abs(vector[:2]) ** 2) / np.sum(np.abs(vector) ** 2)
            modes.append((share_of_x, (-np.angle(value) / 2 / np.pi) % 1))
    modes.sort(reverse=True)
    return np.array([modes[0][1], modes[1][1]])


class Orbits:
    """Closed orbits of all frames with these effects.

    ``monitors`` (frames, monitors, 2) [mm], ``quads`` (frames, 48, 3, 2) in the quadrupoles [m], ``tunes``, and ``optics``: for each
    RF step the derivatives from the start to the monitors, to the quadrupoles and over a turn, in the first frame that has it.
    """

    def __init__(self, tracker, machine, effects):
        plan = machine.plan
        self.tracker, self.machine, self.effects = tracker, machine, effects
        self.monitors = np.zeros((plan.frames, len(plan.monitors), 2))
        self.quads = np.zeros((plan.frames, 48, 3, 2))
        self.tunes = np.zeros((plan.frames, 2))
        self.optics = {}
        self.starts, self.offsets = {}, {}                   # where the search begins when the same setting comes again
        self.reference_orbit()
        for f in range(plan.frames):
            self.follow(f)

    def reference_orbit(self):
        """The orbit with the correctors off and the supplies nominal; RF steps are relative to its frequency."""
        frame = make_frame(self.machine, self.effects, 0, np.zeros(3))
        frame.correctors_on = False
        self.tracker.set(frame)
        self.base, _, _, self.reference_zeta = self.tracker.orbit(self.machine.start, 0.0)

    def follow(self, f):
        """One frame."""
        plan, tracker = self.machine.plan, self.tracker
        frame = make_frame(self.machine, self.effects, f, self.machine.ripple[f])
        tracker.set(frame)
        key = plan.settings[f]
        guess, delta = self.starts.get(key, self.base), frame.delta
        if frame.drf != 0 or frame.frequency_held:
            guess, offset = self.offset_of_frequency(frame, key, guess)
            delta = delta + offset
            if frame.frequency_held:
                delta += DIPOLE_TO_MOMENTUM * frame.dipole_ripple
        z, inside, derivatives, _ = tracker.orbit(guess, delta)
        self.starts[key] = z
        self.monitors[f] = inside[[0, 2]][:, tracker.at_monitors].T * 1e3
        self.quads[f] = np.moveaxis(inside[[0, 2]][:, tracker.at_quads], 0, -1)
        self.tunes[f] = tunes(derivatives[:, :, -1])
        if plan.drf[f] not in self.optics:
            self.optics[plan.drf[f]] = (derivatives[:, :, tracker.at_monitors].copy(), derivatives[:, :, tracker.at_quads].copy(),
                                        derivatives[:, :, -1].copy())

    def offset_of_frequency(self, frame, key, guess):
        """Momentum offset at which the beam turns with the RF frequency.  Newton's method with the design ring's slip factor."""
        circumference = self.machine.plan.machine["circumference_m"]
        offset = self.offsets.get(key, frame.drf / -SLIP)
        again = frame.frequency_held and key in self.offsets     # the same setting differs by the supplies' ripple only
        for _ in range(1 if again else 3):
            guess, _, _, zeta = self.tracker.orbit(guess, offset)
            offset -= (zeta - self.reference_zeta - circumference * frame.drf) / (-SLIP * circumference)
        self.offsets[key] = offset
        return guess, offset


# ------------------------------------------------------------------------------------------------------- effects on the beam

def make_frame(machine, effects, f, ripple):
    """One frame of the machine with these effects, at these relative deviations of the three supplies."""
    frame = Frame(machine, f, ripple)
    for e in effects:
        for change in (change_optics, change_straights, change_timing, change_correctors):
            change(frame, machine.plan, e)
    return frame


def change_optics(frame, plan, e):
    """Effects in the quadrupoles, dipoles and sextupoles, the same in every frame."""
    kind, at, a = e["kind"], e["at"], e.get("amplitude")
    if kind == "quad_roll":
        frame.quad_roll[plan.quad_cells.index(at)] += a
    elif kind == "sextupole_error":
        frame.sextupole_k2l[plan.sextupoles.index(at)] = a
    elif kind == "dipole_midplane_asymmetry":
        frame.dipole_k1sl = a
    elif kind == "shorted_pole_coil":
        i = plan.quad_cells.index(at)
        field = shorted_coil(a, plan.quad_k1[i] * plan.quad_length[i])
        frame.quad_normal[i], frame.quad_skew[i] = field.real, field.imag


def change_straights(frame, plan, e):
    """Effects in the free straights."""
    kind, at, a = e["kind"], e["at"], e.get("amplitude")
    if kind == "stray_skew_gradient":
        frame.slot_skew[plan.slots.index(at), 1] = a
    elif kind == "skew_sextupole_field":
        frame.slot_skew[plan.slots.index(at), 2] = a
    elif kind == "septum_fringe_gradient":
        frame.slot_normal[plan.slots.index(at), 1] = a
    elif kind == "axial_field":
        frame.solenoid = a
    elif kind == "unshielded_cable":
        field = cable(a)
        frame.slot_normal[plan.slots.index(at)], frame.slot_skew[plan.slots.index(at)] = field.real, field.imag
    elif kind == "neighbour_line_pulsed":
        frame.slot_skew[plan.slots.index(at), 0] = a if 120 <= frame.index < 230 else 0.0


def change_timing(frame, plan, e):
    """Effects on quadrupoles and momentum that change from frame to frame."""
    kind, at, a = e["kind"], e["at"], e.get("amplitude")
    if kind == "quad_drift":
        frame.gradient_factor *= 1 + a * (2 * frame.time - 1)
    elif kind == "quad_turn_short_midway":
        frame.gradient_factor[plan.quad_cells.index(at)] *= 1 + (a if frame.index >= 190 else 0.0)
    elif kind == "regulator_hunting":
        frame.gradient_factor[:24] *= 1 + a * math.sin(2 * np.pi * frame.index / 23.7)
    elif kind == "mains_sag_on_trim_load":
        frame.gradient_factor *= 1 + (a if np.abs(plan.current[frame.index]).max() > 1 else 0.0)
    elif kind == "girder_creep":
        frame.quad_shift[plan.quad_cells.index(at), 1] += a * frame.time
    elif kind == "cycle_alternation":
        frame.delta += a * (frame.index % 2)
    elif kind == "rf_frequency_held":
        frame.frequency_held = True
    elif kind == "rf_step_miscaled":
        frame.drf *= 1 + a


def change_correctors(frame, plan, e):
    """Effects in the correctors and their supplies."""
    kind, a = e["kind"], e.get("amplitude")
    if e["at"] not in plan.correctors:
        return
    c = plan.correctors.index(e["at"])
    setting = plan.current[frame.index, c]
    if kind == "corrector_gain":
        frame.gain[c] *= 1 + a
    elif kind == "corrector_polarity":
        frame.gain[c] *= -1
    elif kind == "corrector_roll":
        frame.corrector_roll[c] += a
    elif kind == "corrector_bipolar_asymmetry":
        frame.gain[c] *= 1 + a * np.sign(setting)
    elif kind == "supply_ground_loop":
        frame.current[plan.correctors.index(e["to"])] += a * setting
    elif kind == "corrector_trips_unseen" and frame.index in e["frames"]:
        frame.current[c] = 0.0
    elif kind == "corrector_field_slow":
        age = plan.age[frame.index, c]
        if age < 20:
            frame.current[c] -= a * math.exp(-age) * (setting - plan.previous[frame.index, c])


def shorted_coil(part, k1l):
    """K(n)L + i K(n)sL, n = 0..4, that a quadrupole loses when one of its four pole coils gives less by ``part``.

    The coil of the pole at 45 degrees makes a quarter of the gradient, and every other multipole with the same field at the pole.
    """
    field = [-(part / 4) * k1l * POLE_RADIUS ** (1 - n) * np.exp(-1j * (n - 1) * np.pi / 4) * math.factorial(n) for n in range(5)]
    field[0] = 0.0                                           # the dipole part is steered out
    return np.array(field)


def cable(gradient):
    """K(n)L + i K(n)sL, n = 0..5, of a straight wire 60 mm from the beam, 35 degrees above outward: field like 1/(z - z0)."""
    z0 = 0.06 * np.exp(1j * np.radians(35))
    return np.array([-gradient * abs(z0) ** 2 / z0 ** (n + 1) * math.factorial(n) for n in range(6)])


# ---------------------------------------------------------------------------------------------------- effects on the readings

IN_MONITORS = {"bpm_gain", "bpm_roll", "bpm_swap", "pickup_cubic", "filter_memory", "cable_crosstalk", "corrector_current_pickup",
               "adc_clip", "adc_stuck_bit"}  # kinds that leave the beam alone


def read_orbits(machine, orbits, effects, noise):
    """Readings (frames, monitors) [mm]: first what happens to the signals, then gain, offset and ``noise``, then the digital part."""
    gain, roll = machine.monitor_gain.copy(), machine.monitor_roll.copy()
    for e in effects:
        if e["kind"] == "bpm_gain":
            gain[machine.plan.monitors.index(e["at"])] *= 1 + e["amplitude"]
        elif e["kind"] == "bpm_roll":
            roll[machine.plan.monitors.index(e["at"])] += e["amplitude"]
    x, y = orbits.monitors[:, :, 0], orbits.monitors[:, :, 1]
    c, s = np.cos(roll), np.sin(roll)
    signal = np.where(machine.plan.reads_x, x * c + y * s, y * c - x * s)
    for e in effects:
        change_signal(signal, machine.plan, e)
    readings = signal * gain + machine.monitor_offset + noise
    for e in effects:
        change_digits(readings, machine.plan, e)
    return readings


def change_signal(signal, plan, e):
    """Effects in a monitor's analogue electronics."""
    kind, a = e["kind"], e.get("amplitude")
    if e["at"] not in plan.monitors:
        return
    m = plan.monitors.index(e["at"])
    if kind == "pickup_cubic":
        signal[:, m] += a * signal[:, m] ** 3
    elif kind == "filter_memory":
        for f in range(1, plan.frames):
            signal[f, m] = (1 - a) * signal[f, m] + a * signal[f - 1, m]
    elif kind == "cable_crosstalk":
        signal[:, m] += a * signal[:, plan.monitors.index(e["to"])]
    elif kind == "corrector_current_pickup":
        signal[:, m] += a * plan.current[:, plan.correctors.index(e["to"])]


def change_digits(readings, plan, e):
    """Effects in a monitor's digitizer, and exchanged cables."""
    kind, a = e["kind"], e.get("amplitude")
    if kind == "bpm_swap":
        i, j = (plan.monitors.index(m) for m in e["at"].split(","))
        readings[:, [i, j]] = readings[:, [j, i]]
    elif kind == "adc_clip":
        m = plan.monitors.index(e["at"])
        readings[:, m] = np.clip(readings[:, m], -a, a)
    elif kind == "adc_stuck_bit":
        m = plan.monitors.index(e["at"])
        step = a / 8                                         # the stuck bit is the fourth from below
        number = np.floor((readings[:, m] + 40.96) / step).astype(int)
        readings[:, m] = (number | 8) * step - 40.96


# ------------------------------------------------------------------------------------------------ an ordinary machine

class Machine:
    """One machine with its ordinary imperfections, and all that is random in its campaign but the effects.

    The ordinary imperfections are:

    noise_excess          noise of the readings is larger than the header says, by this part
    slow_noise_mm         additional noise of every monitor that is correlated over slow_tau_frames, rms
    slow_tau_frames       correlation time of the slow noise in frames, 12 if not given
    wander_mm             monitors whose offset does a random walk, and its rms at the end
    noisy                 one monitor, and the factor of its noise
    dead                  one monitor without readings
    lost_frames           number of frames with meaningless readings and tunes
    mon_gain_rms          scatter of the monitors' gains
    mon_roll_rms          scatter of the monitors' rolls [rad]
    cor_gain_rms          scatter of the correctors' gains
    cor_roll_rms          scatter of the correctors' rolls [rad]
    cor_all               common gain error of all correctors
    cor_remanence         part of its previous setting that a corrector remembers
    quad_roll_rms         scatter of the quadrupoles' rolls [rad]
    momentum_jitter       relative momentum error, new in every frame
    dipole_gradient_k1l   gradient K1L of every dipole [1/m]
    dipole_sextupole_k2l  sextupole K2L of every dipole [1/m2]
    """

    def __init__(self, seed, ordinary, tracker):
        self.seed, self.ordinary, self.plan = seed, ordinary, tracker.plan
        rng = np.random.default_rng(seed)
        while True:
            self.draw_ring(rng)
            if self.usable(tracker):
                break
        self.draw_readings(rng)

    def draw_ring(self, rng):
        """Strengths, misalignments, gains, rolls and supplies."""
        plan = self.plan

        def scatter(key, n):
            return rng.normal(0, self.ordinary[key], n) if self.ordinary.get(key) else np.zeros(n)
        self.vars = np.exp(rng.normal(0, PRIOR, 48))
        self.quad_shift = rng.normal(0, 3e-4, (2, 48)).T
        self.quad_roll = scatter("quad_roll_rms", 48)
        self.monitor_gain = 1 + scatter("mon_gain_rms", len(plan.monitors))
        self.monitor_roll = scatter("mon_roll_rms", len(plan.monitors))
        self.corrector_gain = (1 + self.ordinary.get("cor_all", 0.0)) * (1 + scatter("cor_gain_rms", 48))
        self.corrector_roll = scatter("cor_roll_rms", 48)
        self.jitter = scatter("momentum_jitter", plan.frames)
        self.ripple = rng.normal(0, SUPPLY_RIPPLE, (plan.frames, 3))

    def usable(self, tracker):
        """Whether the ring is stable, with both tunes away from integers and half integers, and the orbit below 6 mm."""
        tracker.set(Frame(self, 0, np.zeros(3)))
        try:
            self.start, inside, derivatives, _ = tracker.orbit(np.zeros(4), 0.0)
            self.tunes = tunes(derivatives[:, :, -1])
        except RuntimeError:
            return False
        distance = np.abs(self.tunes * 2 - np.round(self.tunes * 2)).min() / 2
        self.largest = np.abs(inside[[0, 2]][:, tracker.at_monitors]).max()
        return distance > 0.08 and np.all((self.tunes > 0.5) & (self.tunes < 1)) and self.largest < 6e-3

    def draw_readings(self, rng):
        """Offsets and noise of the monitors, frames that are lost, and the read-backs of the supplies."""
        plan, ordinary = self.plan, self.ordinary
        shape = (plan.frames, len(plan.monitors))
        self.monitor_offset = rng.normal(0, 0.5, len(plan.monitors))
        white = rng.normal(0, SIGMA * (1 + ordinary.get("noise_excess", 0)), shape)
        if "noisy" in ordinary:
            monitor, factor = ordinary["noisy"]
            white[:, plan.monitors.index(monitor)] *= factor
        slow = np.zeros(shape)
        if "slow_noise_mm" in ordinary:
            slow += slow_noise(rng.normal(0, ordinary["slow_noise_mm"], shape), ordinary.get("slow_tau_frames", 12.0))
        for monitor, end in ordinary.get("wander_mm", {}).items():
            slow[:, plan.monitors.index(monitor)] += np.cumsum(rng.normal(0, end / math.sqrt(plan.frames), plan.frames))
        self.noise = white + slow
        self.lost = sorted(rng.choice(plan.frames, ordinary.get("lost_frames", 0), replace=False).tolist())
        self.read_back = NOMINAL * (1 + self.ripple + rng.normal(0, SUPPLY_READ_BACK, (plan.frames, 3)))

    def good_monitors(self):
        """Indices of the monitors that are neither dead nor known to be noisy."""
        bad = {self.ordinary.get("dead"), self.ordinary.get("noisy", (None,))[0]}
        return [i for i, m in enumerate(self.plan.monitors) if m not in bad]


def slow_noise(white, tau):
    """First-order autoregressive series of the same rms as ``white`` (frames, monitors)."""
    memory = math.exp(-1 / tau)
    out, value = np.zeros(white.shape), white[0]
    for f, new in enumerate(white):
        value = memory * value + math.sqrt(1 - memory * memory) * new
        out[f] = value
    return out


# ---------------------------------------------------------------------------------------------------------------- gains

class Fit:
    """What 48 vars and a free baseline for every monitor, free to move with the three supplies, can do about a change of readings.

    The vars have their prior, the readings the noise of the header; the change is linear in the vars.
    """

    def __init__(self, machine, orbits):
        plan = machine.plan
        self.used = machine.good_monitors()
        self.kept = [f for f in range(plan.frames) if f not in machine.lost]
        supplies = (machine.read_back[self.kept] / NOMINAL - 1) / 2e-4
        self.followed, _ = np.linalg.qr(np.column_stack([np.ones(len(self.kept)), supplies]))
        self.signatures = self.without_baselines(var_signatures(machine, orbits)).reshape(-1, 48)
        self.cholesky = np.linalg.cholesky(self.signatures.T @ self.signatures + np.eye(48) / PRIOR ** 2)

    def without_baselines(self, change):
        """What the baselines cannot follow of a change (frames, monitors, ...), in units of the noise."""
        change = change[self.kept][:, self.used]
        flat = change.reshape(len(self.kept), -1)
        flat = flat - self.followed @ (self.followed.T @ flat)
        return flat.reshape(change.shape) / SIGMA

    def gain(self, change):
        """Gain in ln posterior of the true effect over the best fit without it, for a noise-free change of the readings."""
        rest = self.without_baselines(change).ravel()
        fitted = np.linalg.solve(self.cholesky, self.signatures.T @ rest)
        return 0.5 * float(rest @ rest - fitted @ fitted)


def var_signatures(machine, orbits):
    """Change of the readings with each ln var (frames, monitors, 48) [mm], first order, at the frames' own orbits."""
    plan, tracker = machine.plan, orbits.tracker
    count = len(plan.monitors)
    row = np.where(plan.reads_x, 0, 2)
    out = np.zeros((plan.frames, count, 48))
    for drf, (to_monitors, to_quads, matrix) in orbits.optics.items():
        frames = np.nonzero(plan.drf == drf)[0]
        closed = np.linalg.inv(np.eye(4) - matrix)
        for q in range(48):
            downstream = (tracker.at_monitors > tracker.at_quads[q, 1])[:, None, None]
            for point, weight in enumerate((1 / 6, 4 / 6, 1 / 6)):   # Simpson's rule over the quadrupole
                back = np.linalg.inv(to_quads[:, :, q, point])   # a kick here, as if made at the start
                green = np.einsum("ijm,jk->mik", to_monitors, closed @ matrix @ back)
                green = green + np.einsum("ijm,jk->mik", to_monitors, back) * downstream
                green = green[np.arange(count), row][:, [1, 3]]  # of kicks in x and in y
                strength = plan.quad_k1[q] * machine.vars[q] * plan.quad_length[q] * weight
                kicks = strength * (orbits.quads[frames, q, point] - machine.quad_shift[q]) * [-1.0, 1.0]
                out[frames, :, q] += 1e3 * kicks @ green.T
    return out


class Campaign:
    """One machine with and without effects, to find amplitudes that can be seen well but not too well."""

    def __init__(self, tracker, machine):
        self.tracker, self.machine = tracker, machine
        self.clean = Orbits(tracker, machine, [])
        self.fit = Fit(machine, self.clean)
        self.clean_readings = read_orbits(machine, self.clean, [], 0.0)

    def orbits(self, effects):
        """Orbits with these effects; those of the clean machine if only the monitors are affected."""
        if all(e["kind"] in IN_MONITORS for e in effects):
            return self.clean
        return Orbits(self.tracker, self.machine, effects)

    def gain(self, effects, orbits):
        """Gain in ln posterior of these effects."""
        return self.fit.gain(read_orbits(self.machine, orbits, effects, 0.0) - self.clean_readings)

    def gain_at(self, effect, amplitude):
        """Gain in ln posterior of one effect, whose amplitude is set."""
        if amplitude is not None:
            effect["amplitude"] = amplitude
        return self.gain([effect], self.orbits([effect]))

    def choose_amplitude(self, effect, first, wanted):
        """Set the effect's amplitude such that its gain is near ``wanted``; returns its gain.

        ``first`` is the amplitude if no gain is wanted (None for kinds without one), a list of those possible, or where to begin.
        """
        if wanted is None:
            return self.gain_at(effect, first)
        if isinstance(first, list):
            gains = [self.gain_at(effect, a) for a in first]
            best = int(np.argmin([abs(math.log(max(g, 1e-3) / wanted)) for g in gains]))
            effect["amplitude"] = first[best]
            return gains[best]
        return self.search_amplitude(effect, first, wanted)

    def search_amplitude(self, effect, amplitude, wanted):
        """The same from a first amplitude, in at most four steps: a small effect's gain grows with its square."""
        for step in range(4):
            try:
                gain = self.gain_at(effect, amplitude)
            except RuntimeError:                             # not stable with so strong an effect
                if step == 3:
                    raise
                amplitude *= 0.3
                continue
            if abs(gain / wanted - 1) < 0.15:
                return gain
            factor = min(5.0, max(0.2, math.sqrt(wanted / max(gain, 1e-6))))
            amplitude = float(f"{amplitude * factor:.3g}")
        return gain


# ------------------------------------------------------------------------------------------------------------- recordings

def write_frames(path, machine, tunes_of_frames, readings):
    """``frames.csv``: read-backs, readings and measured tunes, with the template's times and settings."""
    plan = machine.plan
    rng = np.random.default_rng(machine.seed + 10 ** 6)
    tunes_read = tunes_of_frames + rng.normal(0, TUNE_NOISE, (plan.frames, 2))
    readings = readings.copy()
    for f in machine.lost:
        readings[f] = rng.uniform(-25, 25, len(plan.monitors))
        tunes_read[f] = rng.random(2) * 0.9
    with open(path, "w") as out:
        out.write(",".join(plan.columns) + "\n")
        for f in range(plan.frames):
            currents = plan.current[f] + rng.normal(0, CORRECTOR_READ_BACK, 48)
            sextupoles = 0.05 + rng.normal(0, 0.0102, 2)
            row = plan.rows[f][:6]
            row += [f"{v:.3f}" for v in machine.read_back[f]]
            row += [f"{v:.6f}" for v in sextupoles]
            row += [f"{v:.4f}" for v in currents]
            row += ["" if m == machine.ordinary.get("dead") else f"{v:.4f}" for m, v in zip(plan.monitors, readings[f])]
            row += [f"{v % 1:.5f}" for v in tunes_read[f]]
            out.write(",".join(row) + "\n")


def named(names, values, digits):
    """Rounded values by name."""
    return {name: round(float(value), digits) for name, value in zip(names, values)}


def ordinary_truth(machine):
    """The ordinary imperfections, with what was drawn for them."""
    plan, ordinary = machine.plan, machine.ordinary
    out = dict(ordinary)
    if machine.lost:
        out["lost_frame_seq"] = [int(plan.rows[f][0]) for f in machine.lost]
    if ordinary.get("mon_gain_rms"):
        out["mon_gains"] = named(plan.monitors, machine.monitor_gain, 5)
    if ordinary.get("cor_gain_rms") or ordinary.get("cor_all"):
        out["cor_gains"] = named(plan.correctors, machine.corrector_gain, 5)
    if ordinary.get("mon_roll_rms"):
        out["mon_rolls"] = named(plan.monitors, machine.monitor_roll, 5)
    if ordinary.get("cor_roll_rms"):
        out["cor_rolls"] = named(plan.correctors, machine.corrector_roll, 5)
    if ordinary.get("quad_roll_rms"):
        out["quad_rolls"] = named(plan.quad_cells, machine.quad_roll, 6)
    return out


def make_campaign(tracker, folder, seed, ordinary, wanted):
    """Simulate one campaign and write it; returns the truth.  ``wanted``: effects with their first amplitudes and wanted gains."""
    machine = Machine(seed, ordinary, tracker)
    campaign = Campaign(tracker, machine)
    effects = [dict(e) for e, _, _ in wanted]
    single_gains = [campaign.choose_amplitude(e, first, gain) for e, (_, first, gain) in zip(effects, wanted)]
    orbits = campaign.orbits(effects)
    gain = campaign.gain(effects, orbits) if effects else 0.0
    readings = read_orbits(machine, orbits, effects, machine.noise)
    truth = {
        "seed": seed,
        "ordinary": ordinary_truth(machine),
        "effects": [{k: v for k, v in e.items() if k not in ("to", "frames")} for e in effects],   # "what" says these in words
        "vars": {cell: float(v) for cell, v in zip(tracker.plan.quad_cells, machine.vars)},
        "oracle_gain": round(gain, 2),
        "base_tunes": [round(float(q), 5) for q in machine.tunes],
        "baseline_max_mm": round(float(machine.largest * 1e3), 2),
    }
    if len(effects) > 1:
        truth["single_gains"] = [round(g, 2) for g in single_gains]
    os.makedirs(folder, exist_ok=True)
    with open(os.path.join(folder, "header.toml"), "w") as f:
        f.write(tracker.plan.header)
    write_frames(os.path.join(folder, "frames.csv"), machine, orbits.tunes, readings)
    with open(os.path.join(folder, "truth.json"), "w") as f:
        json.dump(truth, f, indent=1)
    return truth


# ------------------------------------------------------------------------------------------------------------ the campaigns

EMPTY = [
    {"noise_excess": 0.05, "slow_noise_mm": 0.05, "mon_gain_rms": 0.02},
    {"noise_excess": 0.25, "wander_mm": {"x_C2": 0.3, "y_D5": 0.25, "y_A3": 0.2}, "cor_gain_rms": 0.02},
    {"noise_excess": 0.1, "mon_roll_rms": 0.01, "cor_roll_rms": 0.01, "quad_roll_rms": 1e-3},
    {"noise_excess": 0.15, "cor_all": 0.03, "momentum_jitter": 1e-5, "cor_remanence": 0.003},
    {"noise_excess": 0.08, "dipole_gradient_k1l": 1e-3, "dipole_sextupole_k2l": 0.02, "noisy": ("y_C3", 6.0)},
    {"noise_excess": 0.12, "mon_gain_rms": 0.02, "cor_gain_rms": 0.02, "dead": "x_E2", "lost_frames": 3},
    {"noise_excess": 0.2, "quad_roll_rms": 1e-3, "slow_noise_mm": 0.07, "slow_tau_frames": 30.0, "cor_remanence": 0.003,
     "dipole_gradient_k1l": -1e-3},
    {"noise_excess": 0.06, "mon_roll_rms": 0.01, "mon_gain_rms": 0.02, "cor_all": 0.03, "lost_frames": 2, "wander_mm": {"x_F8": 0.3}},
    {"noise_excess": 0.18, "cor_gain_rms": 0.02, "cor_roll_rms": 0.01, "momentum_jitter": 1e-5, "dipole_sextupole_k2l": -0.02,
     "dead": "y_F3"},
    {"noise_excess": 0.1, "slow_noise_mm": 0.04, "wander_mm": {"y_B1": 0.3}, "mon_gain_rms": 0.02, "cor_gain_rms": 0.02,
     "mon_roll_rms": 0.01, "cor_roll_rms": 0.01, "quad_roll_rms": 1e-3, "cor_all": 0.03, "momentum_jitter": 1e-5,
     "dipole_gradient_k1l": 1e-3, "cor_remanence": 0.003, "dipole_sextupole_k2l": 0.02, "noisy": ("x_B4", 5.0), "lost_frames": 3},
]


def mild(name, monitors):
    """Five ordinary imperfections for the campaign of this name; ``monitors`` are those that may be affected."""
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    out = {"noise_excess": round(float(rng.uniform(0, 0.1)), 3)}
    options = [
        ("slow_noise_mm", lambda: 0.04),
        ("wander_mm", lambda: {str(rng.choice(monitors)): 0.2}),
        ("mon_gain_rms", lambda: 0.01),
        ("cor_gain_rms", lambda: 0.01),
        ("mon_roll_rms", lambda: 0.005),
        ("cor_roll_rms", lambda: 0.005),
        ("quad_roll_rms", lambda: 5e-4),
        ("cor_all", lambda: round(float(rng.uniform(-0.015, 0.015)), 4)),
        ("momentum_jitter", lambda: 5e-6),
        ("dipole_gradient_k1l", lambda: 5e-4),
        ("cor_remanence", lambda: 0.0015),
        ("dipole_sextupole_k2l", lambda: 0.01),
        ("dead", lambda: str(rng.choice(monitors))),
        ("lost_frames", lambda: 1),
    ]
    for i in sorted(rng.choice(len(options), 5, replace=False)):
        key, draw = options[i]
        out[key] = draw()
    return out


def effect(kind, at, amplitude=None, gain=None, what=None, **more):
    """An effect for ``make_campaign``: itself, the first amplitude (or those possible), and the wanted gain in ln posterior."""
    e = {"kind": kind, "at": at}
    if what:
        e["what"] = what
    e.update(more)
    return e, amplitude, gain


SINGLE = [
    effect("bpm_gain", "y_A5", -0.06, 110),
    effect("corrector_gain", "H_C2", 0.04, 26),
    effect("bpm_roll", "y_D3", 0.08, 60),
    effect("corrector_roll", "V_D7", -0.05, 85),
    effect("quad_roll", "E1", 0.004, 55),
    effect("stray_skew_gradient", "SLOT_F6", -0.007, 75),
    effect("corrector_polarity", "V_F3"),
    effect("bpm_swap", "y_A1,y_A7"),
    effect("sextupole_error", "SXH_D6", 0.4, 42),
    effect("quad_drift", "", 0.003, 50),
    effect("bpm_gain", "x_C6", 0.05, 20),
    effect("corrector_roll", "H_E4", 0.05, 32),
]

TWO = [
    [effect("bpm_gain", "x_B4", 0.08, 60), effect("quad_roll", "A8", -0.005, 45)],
    [effect("corrector_gain", "V_E5", -0.07, 45), effect("bpm_roll", "y_D5", 0.05, 50)],
    [effect("stray_skew_gradient", "SLOT_E6", 0.006, 60), effect("corrector_polarity", "H_A6")],
    [effect("bpm_swap", "x_D2,x_E2"), effect("sextupole_error", "SXV_B5", -0.2, 50)],
    [effect("quad_drift", "", -0.003, 16), effect("corrector_roll", "V_C7", 0.05, 18)],
    [effect("bpm_roll", "y_F5", -0.03, 13), effect("corrector_gain", "H_A8", 0.05, 18)],
]


def invented_magnets():
    """Effects of nobody's table: fields that do not change."""
    return [
        effect("dipole_midplane_asymmetry", "", 5e-4, 90,
               "upper and lower coil of every main dipole differ: each dipole has this skew gradient (K1sL, 1/m)"),
        effect("shorted_pole_coil", "B8", 0.3, 13,
               "one pole coil of the quadrupole has shorted turns: it gives less field by this part, which makes gradient, sextupole, "
               "octupole and skew parts (the dipole part is steered out)"),
        effect("skew_sextupole_field", "SLOT_A6", 0.5, 14,
               "skew sextupole field (K2sL, 1/m^2) of a tilted device in the straight"),
        effect("axial_field", SOLENOID_SLOT, 0.02, 120,
               "one metre of field along the beam in the straight (ks, 1/m, over 1 m): a solenoid of an experiment"),
        effect("unshielded_cable", "SLOT_F6", 0.003, 60,
               "a power cable parallel to the beam at 60 mm, 35 degrees above outward: field like 1/distance; amplitude is its gradient "
               "on the axis (integrated over the rigidity, 1/m), from dipole to decapole"),
        effect("septum_fringe_gradient", "SLOT_C3", 0.006, 28,
               "normal gradient (K1L, 1/m) of the septum fringe in the straight"),
    ]


def invented_changes():
    """Effects of nobody's table: magnets and momentum that change during the campaign."""
    return [
        effect("quad_turn_short_midway", "B4", 0.01, 90,
               "the quadrupole changes by this part from frame 190 on: a turn-to-turn short"),
        effect("regulator_hunting", "", 0.002, 60,
               "all horizontal quadrupoles swing by this part as a sine of 23.7 frames, unseen by the read-back"),
        effect("mains_sag_on_trim_load", "", 0.003, 30,
               "all quadrupoles change by this part whenever any corrector is powered"),
        effect("neighbour_line_pulsed", "SLOT_D3", 2e-5, 150,
               "vertical kick (rad) of a neighbouring beam line that is on from frame 120 to 229"),
        effect("girder_creep", "C1", 1e-4, 32,
               "the quadrupole moves up linearly, by this many metres over the campaign"),
        effect("cycle_alternation", "", 2e-5, 100,
               "every second cycle has this momentum offset: another user between alters the remanence"),
    ]


def invented_monitors():
    """Effects of nobody's table: monitors."""
    return [
        effect("pickup_cubic", "x_D2", 0.003, 60, "pick-up nonlinearity: reading = x + a x^3 (1/mm^2)"),
        effect("adc_clip", "x_E6", [9.0, 8.0, 7.0, 6.0, 5.5, 5.0, 4.5, 4.0, 3.5, 3.0, 2.5, 2.0, 1.5, 1.0, 0.7], 90,
               "the digitizer clips at plus and minus this many mm"),
        effect("filter_memory", "y_D3", 0.1, 65,
               "the averaging filter is not reset between cycles: this part of the last output is mixed in"),
        effect("cable_crosstalk", "y_E5", 0.06, 50, "this part of the signal of y_E7 couples into this monitor", to="y_E7"),
        effect("corrector_current_pickup", "x_E6", 0.02, 22,
               "the monitor electronics pick up the current of corrector H_E6 (mm/A)", to="H_E6"),
        effect("adc_stuck_bit", "x_F2", [0.16, 0.24, 0.32, 0.64], 90, "the bit of this weight (mm) in the digitizer is always 1"),
    ]


def invented_supplies(plan):
    """Effects of nobody's table: RF and correctors."""
    powered = [f for f, (cell, setting, _) in enumerate(plan.settings) if cell == "F4" and abs(setting) > 1]
    tripped = [powered[1], powered[4]]
    return [
        effect("rf_frequency_held", "", 1.0, None,
               "the RF frequency, not the momentum, stays: the momentum follows path length and dipole current"),
        effect("corrector_bipolar_asymmetry", "V_D3", 0.1, 36,
               "the bipolar supply gives more for positive and less for negative current, by this part; the read-back does not show it"),
        effect("supply_ground_loop", "H_C8", 0.1, 60,
               "this part of the current of H_C8 also flows through H_D2, unseen by its read-back", to="H_D2"),
        effect("corrector_trips_unseen", "H_F4", 2, None,
               f"the corrector gives nothing in this many of its frames (seq {tripped[0]}, {tripped[1]}) though the read-back says it "
               "does", frames=tripped),
        effect("corrector_field_slow", "V_D7", 0.2, 26,
               "eddy currents: the field lags, a part a exp(-k) of the last step is missing k frames after the change"),
        effect("rf_step_miscaled", "", 0.05, 60, "the true RF steps are larger than recorded by this part"),
    ]


def campaigns(plan):
    """Name, seed, ordinary imperfections and effects of every campaign."""
    for i, ordinary in enumerate(EMPTY):
        yield f"a{i + 1:02d}", 7000 + i, ordinary, []
    invented = invented_magnets() + invented_changes() + invented_monitors() + invented_supplies(plan)
    for letter, seed, sets in (("b", 7100, [[e] for e in SINGLE]), ("c", 7200, [[e] for e in invented]), ("d", 7300, TWO)):
        for i, wanted in enumerate(sets):
            name = f"{letter}{i + 1:02d}"
            concerned = {place for e, _, _ in wanted for place in e["at"].split(",") + [e.get("to")]}
            yield name, seed + i, mild(name, [m for m in plan.monitors if m not in concerned]), wanted


def main():
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--machine", required=True, metavar="FILE", help="booster.json")
    parser.add_argument("--template", required=True, metavar="RECORDING_FOLDER", help="recording whose settings and times are taken")
    parser.add_argument("--out", required=True, metavar="DIR", help="folder for the campaigns")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="other machines and noise, their effects of about the same gains")
    parser.add_argument("names", nargs="*", metavar="NAME", help="campaigns to write, all if none is given")
    options = parser.parse_args()
    with open(options.machine) as f:
        plan = Plan(json.load(f), options.template)
    todo = list(campaigns(plan))
    unknown = set(options.names) - {name for name, *_ in todo}
    if unknown:
        parser.error(f"no such campaign: {', '.join(sorted(unknown))}")
    trackers = {}
    for name, seed, ordinary, wanted in todo:
        if options.names and name not in options.names:
            continue
        start = time.time()
        with_solenoid = any(e["kind"] == "axial_field" for e, _, _ in wanted)
        if with_solenoid not in trackers:
            trackers[with_solenoid] = Tracker(plan, with_solenoid)
        folder = os.path.join(options.out, name)
        truth = make_campaign(trackers[with_solenoid], folder, seed + 10_000 * options.seed, ordinary, wanted)
        what = ", ".join(f"{e['kind']}@{e['at'] or '-'}={e.get('amplitude', '-')}" for e in truth["effects"]) or "no effect"
        print(f"{name} {what} gain {truth['oracle_gain']} orbit {truth['baseline_max_mm']} mm tunes {truth['base_tunes']} "
              f"{time.time() - start:.1f} s", flush=True)


if __name__ == "__main__":
    main()
