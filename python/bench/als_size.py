"""A ring of the size of the Advanced Light Source, by pyAT: 12 cells of 16.4 m, 72 quadrupoles, 36 dipoles with gradients, 72 monitors and
72 correctors of both planes, 1.9 GeV."""

import contextlib
import io

import numpy as np

with contextlib.redirect_stdout(io.StringIO()):  # a word on plotting, which is not used
    import at

CELLS = 12
BEND = dict(length=0.86621, bending_angle=2 * np.pi / (3 * CELLS), k=-0.778)
K1 = {"QF": 1.95, "QD": -2.5, "QFA": 2.5}  # 1/m^2
LENGTH = {"QF": 0.344, "QD": 0.187, "QFA": 0.448}  # m


STEPS = 20  # of pyAT's integrator, whose error goes with the fourth power of their length


def bend():
    face = BEND["bending_angle"] / 2  # rectangular
    return at.Dipole("B", **BEND, EntranceAngle=face, ExitAngle=face, NumIntSteps=STEPS)


def quadrupole(name):
    return at.Quadrupole(name, LENGTH[name], K1[name], NumIntSteps=STEPS)


def drift(length):
    return at.Drift("D", length, PassMethod="ExactDriftPass")


def station():
    """A monitor and a corrector behind it."""
    return [at.Monitor("BPM"), at.Corrector("COR", 0.0, [0.0, 0.0])]


def half_cell():
    return [
        *[drift(3.683185), *station(), drift(0.296), quadrupole("QF"), drift(0.2155), quadrupole("QD"), drift(0.219)],
        *[bend(), drift(0.213), *station(), drift(0.6), quadrupole("QFA"), drift(0.35), *station(), drift(0.42)],
    ]


def ring():
    """The lattice."""
    elements = []
    for _ in range(CELLS):
        behind = [*station(), drift(0.62), quadrupole("QFA"), drift(0.763), *station(), drift(0.05), bend()]
        behind += [
            drift(0.219),
            quadrupole("QD"),
            drift(0.2155),
            quadrupole("QF"),
            drift(0.296),
            *station(),
            drift(3.683185),
        ]
        elements += [*half_cell(), bend(), *behind]
    lattice = at.Lattice(elements, name="als-size", energy=1.9e9, periodicity=1)
    lattice.disable_6d()
    return lattice
