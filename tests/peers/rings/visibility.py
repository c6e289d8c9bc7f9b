"""How visible a change of the noise-free readings is, once all that is allowed to follow it has followed.

A gain is half of the chi-square of the readings with an effect against those without it, in nat.  Before it is taken,
each monitor's baseline is free, and all quadrupole factors follow linearly within their priors; where the gains of
monitors and correctors scatter, so may they.  The linear model is that of the machine without effects, by differences
of pyAT's one-turn maps about its closed orbit.

Units: readings in millimetres, currents in amperes.
"""
import numpy as np

from lattices import at
from machine import CHANGE

STEP = 1e-4                                  # of a quadrupole's gradient, relative
MOMENTUM_STEP = 1e-5
LEAST_GAIN_SCATTER = 1e-4


class LinearModel:
    """Readings of a machine without effects, linear in its corrector currents, and their changes with its factors.

    ``response`` (monitors, drives) [mm per A, and per relative RF frequency], ``drives`` (frames, correctors and RF),
    ``readings`` (frames, monitors), ``by_factor`` (frames, monitors, parameters).
    """

    def __init__(self, machine):
        self.machine = machine
        self.ring = machine.ring
        self.rf_is_fixed = machine.equipment.believed_rf == "fixed_frequency"
        self.lattice, quadrupoles = machine.lattice([])
        for quadrupole in quadrupoles:
            quadrupole.set(quadrupole.gradient)
        by_name = {quadrupole.name: quadrupole for quadrupole in quadrupoles}
        self.place_instruments()
        rf_steps = np.array([[frame.rf_step for frame in machine.frames]]).T
        self.has_rf_steps = bool(np.any(rf_steps))
        is_set = np.abs(machine.current) > CHANGE * machine.equipment.current
        self.drives = np.concatenate([np.where(is_set, machine.current, 0), rf_steps], 1)
        self.response = self.find_response()
        self.readings = self.drives @ self.response.T
        changes = []
        for names in self.ring.parameters.values():
            quadrupoles = [by_name[name] for name in names]
            for quadrupole in quadrupoles:
                quadrupole.set(quadrupole.gradient * (1 + STEP))
            changes.append((self.find_response() - self.response) / STEP)
            for quadrupole in quadrupoles:
                quadrupole.set(quadrupole.gradient)
        self.by_factor = np.stack([self.drives @ change.T for change in changes], 2)

    def place_instruments(self):
        """Points of the lattice where something is read or kicked, and which of them are whose."""
        index, ring = self.ring.index, self.ring
        self.points = np.array(sorted({index[i.element] for i in ring.monitors + ring.correctors}))
        number = {point: n for n, point in enumerate(self.points)}
        self.monitor_at = np.array([number[index[m.element]] for m in ring.monitors])
        self.monitor_row = np.array([0 if m.plane == "H" else 2 for m in ring.monitors])
        self.corrector_at = [number[index[c.element]] for c in ring.correctors]

    def find_response(self):
        """Response of all monitors to all correctors [mm/A] and to the relative RF frequency [mm]."""
        equipment, at_monitors = self.machine.equipment, (self.monitor_at, self.monitor_row)
        start, _ = at.find_orbit4(self.lattice, 0.0)
        turn, to_points = at.find_m44(self.lattice, 0.0, refpts=self.points, orbit=start)
        from_points = np.linalg.inv(to_points)
        by_frequency = np.zeros(len(self.ring.monitors))
        if self.rf_is_fixed or self.has_rf_steps:
            dispersion, slip = self.find_dispersion()
            by_frequency = dispersion[at_monitors] * (-1 / slip)
        out = np.zeros((len(self.ring.monitors), len(self.ring.correctors)))
        for j, corrector in enumerate(self.ring.correctors):
            c, row = self.corrector_at[j], 0 if corrector.plane == "H" else 2
            kick = np.zeros(4)
            kick[row + 1] = 1
            after = np.linalg.solve(np.eye(4) - to_points[c] @ turn @ from_points[c], kick)
            orbit = to_points @ from_points[c] @ after
            orbit[:c + 1] = to_points[:c + 1] @ turn @ from_points[c] @ after            # once round the ring
            out[:, j] = orbit[at_monitors]
            if self.rf_is_fixed:                             # the kick lengthens the path, which the momentum undoes
                out[:, j] += dispersion[at_monitors] * (-dispersion[c, row] / self.ring.circumference / slip)
        return np.concatenate([out * equipment.kick_per_ampere, by_frequency[:, None] * 1e3], 1)

    def find_dispersion(self):
        """Dispersion (points, 6) and slip factor: relative lengthening of the period with the relative momentum."""
        points = np.append(self.points, len(self.lattice))
        step = MOMENTUM_STEP
        start_above, above = at.find_orbit4(self.lattice, step, refpts=points)
        start_below, below = at.find_orbit4(self.lattice, -step, refpts=points)
        longer = (above[-1, 5] - start_above[5]) - (below[-1, 5] - start_below[5])
        slip = longer / (2 * step) / self.ring.circumference - self.ring.gamma ** -2
        return (above - below) / (2 * step), slip

    def gain(self, change, with_gains=False):
        """Gain in nat of a change of the readings (frames, monitors) [mm], and that before anything has followed it."""
        machine, imperfections = self.machine, self.machine.campaign.imperfections
        weight = self.weights()
        followed = self.by_factor
        width = list(self.ring.prior_width.values())
        if with_gains:
            by_monitor = self.readings[:, :, None] * np.eye(change.shape[1])
            correctors = len(machine.corrector_names)
            by_corrector = self.response[None, :, :correctors] * self.drives[:, None, :correctors]
            followed = np.concatenate([followed, by_monitor, by_corrector], 2)
            width += [max(imperfections.monitor_gain, LEAST_GAIN_SCATTER)] * change.shape[1]
            width += [max(imperfections.corrector_gain, LEAST_GAIN_SCATTER)] * correctors
        followed = without_baseline(followed * weight[:, :, None], weight).reshape(change.size, -1)
        change = without_baseline(change[:, :, None] * weight[:, :, None], weight).ravel()
        before = change @ change
        normal = followed.T @ followed + np.diag(1 / np.array(width) ** 2)
        slope = followed.T @ change
        return round(float(before - slope @ np.linalg.solve(normal, slope)) / 2, 2), round(float(before) / 2, 2)

    def weights(self):
        """One over the noise of every reading (frames, monitors) [1/mm]; 0 of what is lost, and of faulty monitors."""
        machine = self.machine
        used = ~machine.missing
        used[:, [machine.monitor_names.index(name) for name, _, _ in machine.campaign.imperfections.faulty]] = False
        used[list(machine.lost)] = False
        return used / machine.sigma


def without_baseline(weighted, weight):
    """Weighted series (frames, monitors, ...) without the part that each monitor's free baseline takes."""
    unit = weight / (np.sqrt((weight ** 2).sum(0)) + 1e-30)
    return weighted - unit[:, :, None] * np.einsum("tm,tmp->mp", unit, weighted)
