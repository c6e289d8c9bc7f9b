"""One simulated machine during one orbit-response campaign: what is drawn for it, its closed orbits, and what is read.

All random numbers of a campaign are drawn once, by ``Machine``; ``Machine.track`` can then be called with and without
effects, and the runs differ by nothing else.  Every frame is a closed orbit of pyAT with that frame's currents.

Units: orbits in metres, readings and monitors' offsets in millimetres, currents in amperes, angles in radians.

Signs are MAD's: x outward, y up, x' -= K1L x, y' += K1sL x.  Monitors and correctors roll from x to y: a monitor
reads x cos + y sin or y cos - x sin, an H corrector kicks (cos, sin), a V corrector (-sin, cos).  A quadrupole that
is rolled by a > 0 has turned from x to y as well: K1 cos(2a) and K1s = -K1 sin(2a).  ``bpm_roll`` and
``corrector_roll`` turn one plane of an instrument, the one that is named, also where the instrument has two.
"""
import copy
import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from lattices import at, fractional_tunes

SEED = 20260                                 # followed by the numbers of ring, campaign and attempt
MOMENTUM_STEP = 1e-4                         # for derivatives with the momentum
APERTURE = 0.09                              # the beam is lost further out [m]
CURRENT_NOISE = 4e-5                         # of a corrector's current, over the current of a setting
SETTING_NOISE = 3e-5                         # of a corrector's current, over itself
SUPPLY_OFFSET = 2e-3                         # greatest relative distance of a supply from its nominal current
TUNE_NOISE = 5e-4
JUMP_RATE = 0.06                             # new offsets of a jumping monitor, per frame
CHANGE = 0.05                                # a corrector is set, or changed, by more than this part of a setting
NOMINAL_INTENSITY = 1.5e11                   # of the intensity-dependent offset
CRATE = ("M.14", "M.15", "M.16")             # cells of the monitors whose offsets move with the intensity


# ---------------------------------------------------------------------------------------------- what a campaign is like

@dataclass
class Equipment:
    """What belongs to a ring and is the same in all its campaigns."""

    sigma: float                             # noise of a monitor [mm]
    kick_per_ampere: float                   # of the correctors [mrad/A]
    current: float                           # of a corrector's setting [A]
    displacement: float                      # of the quadrupoles, rms [m]; three times as much: offsets of the monitors
    nominal: dict                            # currents of the quadrupole supplies [A]
    transfer: list | dict                    # coefficients of strength against current, of all supplies or of each
    ripple: float                            # relative, of the quadrupole supplies
    rf_step: float                           # relative change of the revolution frequency in a frame with an RF step
    dipole_current: float | None = None      # None: not recorded, and does not ripple
    dipole_ripple: float = 0.0
    believed_rf: str = "fixed_momentum"
    vertical_sigma: float = 1.0              # noise of vertical monitors, over ``sigma``
    other_sigma: dict = field(default_factory=dict)          # of single monitors [mm]
    planes_roll_together: bool = True        # both planes of a monitor have one roll


@dataclass
class Measurement:
    """What is done in a campaign."""

    repeats: int = 2                         # times that all correctors are gone through
    both_signs: bool = True                  # +I, then -I; else +I only
    and_back: bool = False                   # +I, 0, -I, 0 instead
    zero_every: int = 4                      # a frame without kicks after this many correctors
    rf_steps: int = 0                        # frames with an RF step, of alternating sign, at the end
    left_out: tuple = ()                     # correctors that are not used
    tunes: bool = True                       # are measured
    intensity: bool = False                  # is measured
    format: int = 2                          # of the recording


@dataclass
class Imperfections:
    """An ordinary machine: standard deviations of what every instrument and magnet may have."""

    noise: tuple = (1.0, 1.0)                # of horizontal and vertical monitors, over what the header says
    monitor_gain: float = 0.0
    corrector_gain: float = 0.0
    monitor_roll: float = 0.0                # [rad]
    corrector_roll: float = 0.0              # [rad]
    quad_roll: float = 0.0                   # [rad]
    slow: float = 0.0                        # slow noise of every monitor, over its white noise
    wander: float = 0.0                      # two hidden kicks that vary slowly, at two correctors' places [mrad]
    slow_frames: float = 15                  # correlation time of both [frames]
    momentum_jitter: float = 0.0             # relative
    missing: float = 0.0                     # part of the readings that are lost
    lost: int = 0                            # frames that are lost
    faulty: tuple = ()                       # (monitor, "noisy" or "jumps", times the white noise)


@dataclass
class Campaign:
    """One campaign: what is measured on which machine."""

    scatter: float                           # of the quadrupole factors, in prior widths
    measurement: Measurement
    imperfections: Imperfections = field(default_factory=Imperfections)
    effects: tuple = ()
    displaced: float = 1.0                   # displacements of the quadrupoles, over those of the ring's equipment
    loop_monitors: tuple = ()                # that the radial loop holds


def effect(kind, place=None, amplitude=None):
    """An effect in the words of ``truth.json``: no place for the whole ring, no amplitude for what is there or not."""
    out = {"kind": kind}
    if place is not None:
        out["at"] = place
    if amplitude is not None:
        out["amplitude"] = amplitude
    return out


def total(effects, kind, place=None):
    """Sum of the amplitudes of the effects of one kind at one place."""
    return sum(e["amplitude"] for e in effects if e["kind"] == kind and e.get("at") == place)


def present(effects, kind, place=None):
    """True if there is an effect of this kind at this place."""
    return any(e["kind"] == kind and e.get("at") == place for e in effects)


class Frame(NamedTuple):
    """One setting."""

    corrector: int | None                    # which one is powered
    current: float                           # [A]
    rf_step: float                           # relative


NOTHING_SET = Frame(None, 0.0, 0.0)


def frames_of(measurement, correctors, equipment):
    """All settings of a campaign in their order."""
    names = [c.name for c in correctors]
    left_out = {names.index(name) for name in measurement.left_out}
    used = [i for i in range(len(correctors)) if i not in left_out]
    current = equipment.current
    frames = [NOTHING_SET, NOTHING_SET]
    done = 0
    for _ in range(measurement.repeats):
        for i in used:
            if measurement.and_back:
                frames += [Frame(i, a, 0.0) for a in (current, 0.0, -current, 0.0)]
                continue
            frames.append(Frame(i, current, 0.0))
            if measurement.both_signs:
                frames.append(Frame(i, -current, 0.0))
            done += 1
            if done % measurement.zero_every == 0:
                frames.append(NOTHING_SET)
    for j in range(measurement.rf_steps):
        frames += [Frame(None, 0.0, equipment.rf_step * (-1) ** j), NOTHING_SET]
    frames.append(NOTHING_SET)
    return frames


def slowly_varying(rng, size, time, shape):
    """Series (frames, ...) of standard deviation ``size`` and exponential correlation over ``time`` frames."""
    memory = math.exp(-1 / time)
    draws = rng.normal(0, 1, shape)
    out = np.empty(shape)
    out[0] = draws[0]
    for t in range(1, shape[0]):
        out[t] = memory * out[t - 1] + math.sqrt(1 - memory * memory) * draws[t]
    return size * out


# ---------------------------------------------------------------------------------------------------------- the machine

class Machine:
    """A machine in a campaign, with all that is random about it; the order of the draws decides what a seed gives."""

    def __init__(self, ring, equipment, campaign, seed):
        self.ring = ring
        self.equipment = equipment
        self.campaign = campaign
        self.seed = seed
        self.displacement = equipment.displacement * campaign.displaced
        self.frames = frames_of(campaign.measurement, ring.correctors, equipment)
        self.monitor_names = [m.name for m in ring.monitors]
        self.corrector_names = [c.name for c in ring.correctors]
        rng = np.random.default_rng(seed)
        self.draw_magnets(rng)
        self.draw_instruments(rng)
        self.draw_currents(rng)
        self.draw_slow_changes(rng)
        self.draw_noise(rng)
        self.draw_losses(rng)

    def draw_magnets(self, rng):
        """Factors of the quadrupoles well within their range, displacements and rolls of the quadrupoles."""
        ring, size = self.ring, self.displacement
        self.vars = {}
        for parameter, width in ring.prior_width.items():
            low, high = ring.range[parameter]
            while True:
                value = math.exp(rng.normal(0, self.campaign.scatter * width))
                if low * 1.005 < value < high * 0.995:
                    break
            self.vars[parameter] = value
        self.factor = {name: self.vars[parameter] for parameter, names in ring.parameters.items() for name in names}
        names = [e["name"] for e in ring.quadrupoles]
        self.shift = {name: rng.normal(0, size, 2).clip(-2.5 * size, 2.5 * size) for name in names}
        self.quad_roll = {name: rng.normal(0, self.campaign.imperfections.quad_roll) for name in names}

    def draw_instruments(self, rng):
        """Gains, rolls and offsets of monitors and correctors."""
        imperfections = self.campaign.imperfections
        monitors, correctors = len(self.monitor_names), len(self.corrector_names)
        self.monitor_gain = rng.normal(0, imperfections.monitor_gain, monitors)
        self.monitor_roll = rng.normal(0, imperfections.monitor_roll, monitors)
        self.offset = rng.normal(0, 3 * self.displacement * 1e3, monitors)
        self.corrector_gain = rng.normal(0, imperfections.corrector_gain, correctors)
        self.corrector_roll = rng.normal(0, imperfections.corrector_roll, correctors)
        if self.equipment.planes_roll_together:
            first = {}
            for i, monitor in enumerate(self.ring.monitors):
                self.monitor_roll[i] = self.monitor_roll[first.setdefault(monitor.element, i)]

    def draw_currents(self, rng):
        """Currents of the correctors (frames, correctors) [A]; of supplies and dipoles (frames), over nominal."""
        equipment, n = self.equipment, len(self.frames)
        self.current = rng.normal(0, CURRENT_NOISE * equipment.current, (n, len(self.corrector_names)))
        for t, frame in enumerate(self.frames):
            if frame.corrector is not None:
                self.current[t, frame.corrector] += frame.current * (1 + rng.normal(0, SETTING_NOISE))
        level = {supply: 1 + rng.uniform(-SUPPLY_OFFSET, SUPPLY_OFFSET) for supply in self.ring.supplies}
        self.supply = {s: level[s] * (1 + equipment.ripple * rng.normal(0, 1, n)) for s in self.ring.supplies}
        self.dipole = np.ones(n)
        if equipment.dipole_current:
            self.dipole = 1 + equipment.dipole_ripple * rng.normal(0, 1, n)

    def draw_slow_changes(self, rng):
        """Slow noise of the monitors over their white noise, hidden kicks [mrad], and the momentum."""
        imperfections, n = self.campaign.imperfections, len(self.frames)
        time = imperfections.slow_frames
        self.slow = slowly_varying(rng, imperfections.slow, time, (n, len(self.monitor_names)))
        self.wander = slowly_varying(rng, imperfections.wander, time, (n, 2))
        self.wander_at = rng.integers(0, len(self.corrector_names), 2)
        self.momentum_jitter = rng.normal(0, imperfections.momentum_jitter, n)

    def draw_noise(self, rng):
        """Noise of the readings [mm], with that of faulty monitors."""
        imperfections, n = self.campaign.imperfections, len(self.frames)
        horizontal = np.array([m.plane == "H" for m in self.ring.monitors])
        equipment = self.equipment
        self.believed_sigma = np.where(horizontal, equipment.sigma, equipment.sigma * equipment.vertical_sigma)
        for name, sigma in equipment.other_sigma.items():
            self.believed_sigma[self.monitor_names.index(name)] = sigma
        self.sigma = self.believed_sigma * np.where(horizontal, *imperfections.noise)
        self.noise = rng.normal(0, 1, (n, len(self.monitor_names))) * self.sigma
        self.jumps = np.zeros_like(self.noise)
        for name, fault, size in imperfections.faulty:
            i = self.monitor_names.index(name)
            if fault == "noisy":
                self.noise[:, i] *= size
                continue
            offset = 0.0
            for t in range(n):
                if rng.random() < JUMP_RATE:
                    offset = size * self.sigma[i] * rng.normal()
                self.jumps[t, i] = offset

    def draw_losses(self, rng):
        """Readings and frames that are lost; and the tune meter's noise and the beam's intensity."""
        imperfections, n = self.campaign.imperfections, len(self.frames)
        self.missing = rng.random((n, len(self.monitor_names))) < imperfections.missing
        self.lost = set()
        if imperfections.lost:
            self.lost = set(rng.choice(np.arange(3, n - 1), imperfections.lost, replace=False).tolist())
        self.tune_noise = rng.normal(0, TUNE_NOISE, (n, 2))
        self.tune_missing = rng.random(n) < (0.02 if imperfections.missing else 0)
        decay = np.exp(-((np.arange(n) % 90) / 130.0))       # a fill lasts 90 frames
        self.intensity = 2e11 * decay * (1 + 0.004 * rng.normal(0, 1, n))

    def track(self, effects, with_tunes=False, displaced=True):
        """The run of this machine with these effects; None if it has no stable orbit all the time."""
        try:
            return Run(self, effects, with_tunes, displaced)
        except (ArithmeticError, at.AtError, np.linalg.LinAlgError):
            return None

    def transfer(self, supply):
        """Strength of the quadrupoles of a supply, over nominal, of each frame."""
        coefficients = self.equipment.transfer
        if isinstance(coefficients, dict):
            coefficients = coefficients[supply]
        return sum(c * self.supply[supply] ** n for n, c in enumerate(coefficients)) / sum(coefficients)

    def lattice(self, effects, displaced=True):
        """The pyAT lattice with the fields that do not change, and its ``Quadrupole`` elements."""
        ring = self.ring
        lattice = copy.deepcopy(ring.lattice)
        quadrupoles = []
        for e in ring.quadrupoles:
            element = lattice[ring.index[e["name"]]]
            if displaced:
                dx, dy = self.shift[e["name"]]
                element.T1 = np.array([-dx, 0, -dy, 0, 0, 0.0])
                element.T2 = -element.T1
            roll = self.quad_roll[e["name"]] + total(effects, "quad_roll", ring.quadrupole_label[e["name"]])
            gradient = ring.k1[e["family"]] * self.factor.get(e["name"], 1.0)
            turned = math.cos(2 * roll), -math.sin(2 * roll)
            quadrupoles.append(Quadrupole(e["name"], element, gradient, turned, ring.supply(e)))
        for e in effects:
            apply_field(lattice, ring.index, e)
        return lattice, quadrupoles


class Quadrupole(NamedTuple):
    """A quadrupole whose gradient changes from frame to frame."""

    name: str
    element: at.Element
    gradient: float                          # at nominal currents [1/m^2]
    turned: tuple                            # normal and skew part of a rolled gradient of 1
    supply: str

    def set(self, gradient):
        """Write a gradient into the element."""
        normal, skew = self.turned
        self.element.PolynomB[1] = gradient * normal
        self.element.PolynomA[1] = gradient * skew


def apply_field(lattice, index, e):
    """Put an effect into a lattice, if it is a field that does not change."""
    if e.get("at") not in index:
        return
    kind, amplitude = e["kind"], e.get("amplitude")
    i = index[e["at"]]
    element = lattice[i]
    if kind == "stray_gradient":
        element.PolynomB[1] += amplitude
    elif kind == "stray_skew_gradient":
        element.PolynomA[1] += amplitude
    elif kind == "sextupole_error":
        element.PolynomB[2] += amplitude / 2 / element.Length
    elif kind == "dipole_gradient":
        element.PolynomB[1] += amplitude / element.Length
    elif kind == "dipole_edge":
        element.EntranceAngle += amplitude
        element.ExitAngle += amplitude
    elif kind == "solenoid":                                 # pyAT's K is MAD's ks, twice the rotation per metre
        length = element.Length
        lattice[i] = at.Element(e["at"], Length=length, PassMethod="SolenoidLinearPass", K=2 * amplitude / length)


# -------------------------------------------------------------------------------------------------------------- one run

class Run:
    """Closed orbits of a machine with some effects: noise-free ``readings`` (frames, monitors) [mm], and ``tunes``."""

    def __init__(self, machine, effects, with_tunes, displaced):
        self.machine = machine
        self.ring = machine.ring
        self.effects = effects
        self.lattice, self.quadrupoles = machine.lattice(effects, displaced)
        self.strength = {supply: machine.transfer(supply) for supply in self.ring.supplies}
        self.guess = np.zeros(6)
        self.place_instruments()
        self.current = self.real_currents()
        self.follow_frames(with_tunes)

    def place_instruments(self):
        """Where the instruments are in the lattice, and the kick per ampere (x, y) of every corrector."""
        index = self.ring.index
        points = sorted({index[m.element] for m in self.ring.monitors})
        self.points = np.array(points + [len(self.lattice)])
        self.column = [points.index(index[m.element]) for m in self.ring.monitors]      # of the orbit at the points
        self.kicks = []
        for i, corrector in enumerate(self.ring.correctors):
            self.kicks.append((index[corrector.element], self.kick_per_ampere(i, corrector)))
        self.kicked = sorted({place for place, _ in self.kicks})

    def kick_per_ampere(self, i, corrector):
        """Kick per ampere (x, y) [rad/A] of the corrector number ``i``."""
        machine, effects, name = self.machine, self.effects, corrector.name
        roll = machine.corrector_roll[i] + total(effects, "corrector_roll", name)
        gain = (1 + machine.corrector_gain[i]) * (1 + total(effects, "corrector_gain", name))
        if present(effects, "corrector_polarity", name):
            gain *= -1
        if present(effects, "corrector_dead", name):
            gain = 0.0
        direction = (math.cos(roll), math.sin(roll)) if corrector.plane == "H" else (-math.sin(roll), math.cos(roll))
        return gain * machine.equipment.kick_per_ampere * 1e-3 * np.array(direction)

    def real_currents(self):
        """Currents that act in the correctors (frames, correctors) [A], against those that are recorded."""
        names, setting = self.machine.corrector_names, self.machine.equipment.current
        current = self.machine.current.copy()
        for e in self.effects:
            if e["kind"] == "corrector_hysteresis":
                current = remembering(current, e["amplitude"], CHANGE * setting)
            elif e["kind"] == "corrector_even":
                i = names.index(e["at"])
                current[:, i] = current[:, i] * (1 + e["amplitude"] * current[:, i] / setting)
            elif e["kind"] == "corrector_crosstalk":         # to the next one of its plane
                i = names.index(e["at"])
                current[:, i + 1] += e["amplitude"] * current[:, i]
        return current

    def set_frame(self, t, more_kicks=None):
        """Write the currents of frame ``t`` into the lattice; ``more_kicks``: place there and kick (x, y) [rad]."""
        machine, dipole = self.machine, self.machine.dipole[t]
        for place in self.kicked:
            self.lattice[place].KickAngle = np.zeros(2)
        for i, (place, kick) in enumerate(self.kicks):
            self.kick(place, kick * self.current[t, i] / dipole)
        for j, i in enumerate(machine.wander_at):
            place, kick = self.kicks[i]
            self.kick(place, kick * machine.wander[t, j] / machine.equipment.kick_per_ampere)
        if more_kicks is not None:
            self.kick(*more_kicks)
        drift = total(self.effects, "quad_drift") * (2 * t / (len(machine.frames) - 1) - 1)
        for quadrupole in self.quadrupoles:
            in_series = quadrupole.supply == "dipole"        # with the dipoles: strength and momentum change alike
            relative = 1.0 if in_series else self.strength[quadrupole.supply][t] / dipole
            quadrupole.set(quadrupole.gradient * (1 + drift) * relative)

    def kick(self, place, angles):
        """Add a kick (x, y) [rad] at a place in the lattice."""
        self.lattice[place].KickAngle = self.lattice[place].KickAngle + angles

    def orbit(self, momentum):
        """Closed orbit at this relative momentum, at the start and at the points (points, 6)."""
        start, orbit = at.find_orbit4(self.lattice, momentum, refpts=self.points, guess=self.guess, convergence=1e-11)
        if not np.all(np.isfinite(orbit)) or np.max(np.abs(orbit[:, [0, 2]])) > APERTURE:
            raise ArithmeticError("the beam is lost")
        self.guess = start.copy()
        self.guess[4:] = 0
        return start, orbit

    def period(self, start, orbit, momentum):
        """Relative change of the revolution period against the reference particle's."""
        ring = self.ring
        lengthening = (orbit[-1, 5] - start[5]) / ring.circumference
        p = ring.momentum * (1 + momentum)
        beta = p / math.hypot(p, ring.rest_energy)
        return (1 + lengthening) * ring.beta / beta - 1

    def loop_position(self, start, orbit, momentum):
        """Mean x of the two monitors that a radial loop holds [m]."""
        names = self.machine.monitor_names
        columns = [self.column[names.index(m)] for m in self.machine.campaign.loop_monitors]
        return orbit[columns, 0].mean()

    def follow_frames(self, with_tunes):
        """The orbit of every frame, with what holds the momentum, and what the monitors read of it."""
        machine, n = self.machine, len(self.machine.frames)
        self.find_reference()
        x, y = np.zeros((n, len(self.points) - 1)), np.zeros((n, len(self.points) - 1))
        self.tunes = np.full((n, 2), np.nan)
        for t, frame in enumerate(machine.frames):
            self.set_frame(t)
            momentum = self.reference_momentum + machine.momentum_jitter[t]
            momentum, start, orbit = self.hold_momentum(frame, momentum)
            if self.feedback:
                start, orbit = self.feed_back(t, momentum, orbit)
            x[t] = orbit[:-1, 0] * 1e3
            y[t] = orbit[:-1, 2] * 1e3
            if with_tunes or t == 0:
                tunes = fractional_tunes(at.find_m44(self.lattice, momentum, orbit=start)[0])
                if tunes is None:
                    raise ArithmeticError("the beam is unstable")
                self.tunes[t] = tunes
        self.readings = self.read(x, y)

    def find_reference(self):
        """Revolution period, and what the RF holds, without kicks; with their derivatives by the momentum."""
        self.reference_momentum = total(self.effects, "momentum_offset")
        self.set_frame(0)
        for place in self.kicked:
            self.lattice[place].KickAngle = np.zeros(2)
        above = self.reference_momentum + MOMENTUM_STEP
        reference = (*self.orbit(self.reference_momentum), self.reference_momentum)
        changed = (*self.orbit(above), above)
        self.guess = np.zeros(6)

        def value_and_slope(quantity):
            value = quantity(*reference)
            return value, (quantity(*changed) - value) / MOMENTUM_STEP
        self.reference_period, self.period_slope = value_and_slope(self.period)
        self.held, self.held_share = self.held_quantity()
        if self.held:
            self.held_value, self.held_slope = value_and_slope(self.held)
        self.feedback = next((e for e in self.effects if e["kind"] == "local_feedback"), None)
        if self.feedback:
            self.find_feedback(reference[1])

    def held_quantity(self):
        """What the RF holds in place of the momentum, if anything, and which share of the way to it."""
        if present(self.effects, "radial_loop"):
            return self.loop_position, total(self.effects, "radial_loop")
        if present(self.effects, "fixed_rf_frequency"):
            return self.period, total(self.effects, "fixed_rf_frequency")
        if self.machine.equipment.believed_rf == "fixed_frequency":
            return self.period, 1.0
        return None, 1.0

    def hold_momentum(self, frame, momentum):
        """Momentum, start and orbit of a frame, as the RF holds them."""
        start, orbit = self.orbit(momentum)
        if frame.rf_step != 0:                               # the frequency is set, all loops are open
            for _ in range(3):
                change = self.period(start, orbit, momentum) - self.reference_period + frame.rf_step
                momentum -= change / self.period_slope
                start, orbit = self.orbit(momentum)
        elif self.held:
            held = momentum
            for _ in range(2):
                held -= (self.held(start, orbit, held) - self.held_value) / self.held_slope
                start, orbit = self.orbit(held)
            if self.held_share != 1:
                momentum = momentum + self.held_share * (held - momentum)
                start, orbit = self.orbit(momentum)
            else:
                momentum = held
        return momentum, start, orbit

    def find_feedback(self, reference_orbit):
        """A local feedback: the corrector's place, the monitor's column, its reference and the loop gain."""
        corrector, monitor = self.feedback["at"].split(",")
        self.feedback_place, _ = self.kicks[self.machine.corrector_names.index(corrector)]
        self.feedback_column = self.column[self.machine.monitor_names.index(monitor)]
        self.feedback_y = reference_orbit[self.feedback_column, 2]
        kick = 1e-5
        self.lattice[self.feedback_place].KickAngle = np.array([0, kick])
        _, orbit = self.orbit(self.reference_momentum)
        self.feedback_response = (orbit[self.feedback_column, 2] - self.feedback_y) / kick
        self.feedback_gain = self.feedback["amplitude"] / self.feedback_response

    def feed_back(self, t, momentum, orbit):
        """Start and orbit of a frame when the feedback has settled."""
        gain, kick = self.feedback_gain, 0.0
        for _ in range(2):
            rest = kick + gain * (orbit[self.feedback_column, 2] - self.feedback_y)
            kick -= rest / (1 + gain * self.feedback_response)
            self.set_frame(t, (self.feedback_place, np.array([0, kick])))
            start, orbit = self.orbit(momentum)
        return start, orbit

    def read(self, x, y):
        """What the monitors read of an orbit (frames, points) [mm], with their offsets and without noise."""
        machine, effects = self.machine, self.effects
        out = np.zeros((len(x), len(self.ring.monitors)))
        for i, monitor in enumerate(self.ring.monitors):
            at_x, at_y, name = x[:, self.column[i]], y[:, self.column[i]], monitor.name
            roll = machine.monitor_roll[i] + total(effects, "bpm_roll", name)
            c, s = math.cos(roll), math.sin(roll)
            reading = at_x * c + at_y * s if monitor.plane == "H" else at_y * c - at_x * s
            reading = reading * (1 + total(effects, "bpm_cubic", name) * reading * reading)
            gain = (1 + machine.monitor_gain[i]) * (1 + total(effects, "bpm_gain", name))
            reading = gain * reading + machine.offset[i]
            if present(effects, "bpm_polarity", name):
                reading = -reading
            out[:, i] = reading
        for e in effects:
            if e["kind"] == "bpm_swap":
                pair = [machine.monitor_names.index(name) for name in e["at"].split(",")]
                out[:, pair] = out[:, pair[::-1]]
            elif e["kind"] == "reading_lag":
                for t in range(1, len(out)):
                    out[t] = (1 - e["amplitude"]) * out[t] + e["amplitude"] * out[t - 1]
            elif e["kind"] == "intensity_offset":
                crate = [i for i, name in enumerate(machine.monitor_names) if name[2:6] in CRATE]
                out[:, crate] += e["amplitude"] * (machine.intensity / NOMINAL_INTENSITY - 1)[:, None]
        return out


def remembering(current, share, threshold):
    """Currents of correctors that lack a ``share`` of their last step (more than ``threshold``) until the next one."""
    out = current.copy()
    lacking = np.zeros(current.shape[1])
    for t in range(1, len(current)):
        step = current[t] - current[t - 1]
        lacking = np.where(np.abs(step) > threshold, -share * step, lacking)
        out[t] = current[t] + lacking
    return out
