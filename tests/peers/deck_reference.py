"""Tunes and orbit response of the Booster of the laboratory's deck by pyAT and MAD-X, for tests/golden/reference-deck.json.

24 monitor places x 24 correctors of each plane, half the difference of the closed orbits at +-1 urad over the kick: with sextupoles in
the dipoles, small kicks are what the linear response is the limit of. Strengths are worked out here from the read-backs and the law in
machines/booster-deck.json, apart from the program's own code.

    python tests/peers/deck_reference.py tests/golden/reference-deck.json     (numpy, accelerator-toolbox, cpymad)
"""

import json
import sys
import warnings
from pathlib import Path

import at
import numpy as np
from cpymad.madx import Madx

warnings.filterwarnings("ignore", message="AT tracking still assumes beta==1")

ROOT = Path(__file__).resolve().parents[2]
KICK = 1e-6  # rad
SLICES = 40  # of pyAT's fourth-order integrator, in each magnet
MASS = 0.93827208816  # GeV
LIGHT = 0.299792458  # GeV/c per T m


def powered(machine):
    """Elements with their strengths, and the momentum [GeV/c]."""
    law, read = machine["currents"], machine["currents"]["design_A"]
    poly = lambda c, i: sum(a * i**n for n, a in enumerate(c))
    current = lambda weights: sum(w * read[name] for name, w in weights.items())
    dipole, main = law["dipole"], current(law["dipole"]["current"])
    rigidity = poly(dipole["field_T"], main) * dipole["radius_m"]
    elements = []
    for e in machine["elements"]:
        e = dict(e)
        if e["type"] == "sbend":
            e["k1"] = poly(dipole["k1_radius_1_m"], main) / dipole["radius_m"]
            e["k2"] = poly(dipole["k2_radius_1_m2"], main) / dipole["radius_m"]
        for sort, key in [("quadrupole", "k1"), ("sextupole", "k2")]:
            if e["type"] == sort:
                one = law[sort + "s"][e["family"]]
                e[key] = poly(one["integrated"], current(one["current"])) / (rigidity * e["length"])
        elements.append(e)
    return elements, LIGHT * rigidity


def by_pyat(elements, momentum, circumference):
    line, end = [], 0.0
    for e in elements:
        if e["s_start"] - end > 1e-9:
            line.append(at.Drift("D", e["s_start"] - end))
        name, length = e["name"], e["length"]
        match e["type"]:
            case "corrector":
                made = at.Corrector(name, 0.0, [0.0, 0.0])
            case "bpm" | "marker":
                made = at.Marker(name)
            case "quadrupole":
                made = at.Quadrupole(name, length, e["k1"], NumIntSteps=SLICES)
            case "sextupole":
                made = at.Sextupole(name, length, e["k2"] / 2, NumIntSteps=SLICES)
            case "sbend":
                field = [0.0, e["k1"], e["k2"] / 2]
                made = at.Bend(name, length, e["angle"], e["k1"], PolynomB=field, MaxOrder=2, NumIntSteps=SLICES)
        line.append(made)
        end = e["s_start"] + length
    if circumference - end > 1e-9:
        line.append(at.Drift("D", circumference - end))
    ring = at.Lattice(line, energy=1e9 * np.hypot(momentum, MASS), particle="proton", periodicity=1)
    ring.disable_6d()
    names = [e.FamName for e in ring]
    fractions = ring.get_tune()

    def orbit(corrector, plane, kick, monitors):
        ring[names.index(corrector)].KickAngle[plane] = kick
        _, orbits = ring.find_orbit4(refpts=[names.index(m) for m in monitors])
        ring[names.index(corrector)].KickAngle[plane] = 0.0
        return orbits[:, 2 * plane]

    return [float(4 + q) for q in fractions], orbit


def by_madx(elements, momentum, circumference):
    madx = Madx(stdout=False)
    lines = [f"beam, particle=proton, pc={momentum!r};"]
    for e in elements:
        name, length = e["name"], e["length"]
        kinds = {
            "corrector": "kicker",
            "bpm": "monitor",
            "marker": "marker",
            "quadrupole": f"quadrupole, l={length!r}, k1={e.get('k1')!r}",
            "sextupole": f"sextupole, l={length!r}, k2={e.get('k2')!r}",
            "sbend": f"sbend, l={length!r}, angle={e.get('angle')!r}, k1={e.get('k1')!r}, k2={e.get('k2')!r}",
        }
        lines.append(f"{name}: {kinds[e['type']]};")
    lines.append(f"booster: sequence, l={circumference!r}, refer=entry;")
    lines += [f"{e['name']}, at={e['s_start']!r};" for e in elements]
    lines += ["endsequence;", "use, sequence=booster;"]
    madx.input("\n".join(lines))
    tunes = madx.twiss().summary

    def orbit(corrector, plane, kick, monitors):
        madx.elements[corrector.lower()]["hv"[plane] + "kick"] = kick
        table = madx.twiss()
        madx.elements[corrector.lower()]["hv"[plane] + "kick"] = 0.0
        at_name = {name.split(":")[0]: i for i, name in enumerate(table.name)}
        return np.array([table["xy"[plane]][at_name[m.lower()]] for m in monitors])

    return [float(tunes.q1), float(tunes.q2)], orbit


def main():
    machine = json.loads((ROOT / "machines/booster-deck.json").read_text())
    elements, momentum = powered(machine)
    vars_of = {"design": {}, "paper": json.loads((ROOT / "recordings/deck/paper-vars/truth.json").read_text())["vars"]}
    result = {}
    for word, make in [("pyat", by_pyat), ("madx", by_madx)]:
        for machine_word, factors in vars_of.items():
            scaled = [dict(e) for e in elements]
            for e in scaled:
                if e["type"] == "quadrupole":
                    e["k1"] *= factors.get(e["name"][3:], 1.0)
            tunes, orbit = make(scaled, momentum, machine["circumference_m"])
            one = {"tunes": tunes}
            for plane, letter in enumerate("HV"):
                named = lambda sort: [e["name"] for e in elements if e["type"] == sort and e["plane"] == letter]
                monitors, correctors = named("bpm"), named("corrector")
                columns = [(orbit(c, plane, KICK, monitors) - orbit(c, plane, -KICK, monitors)) / (2 * KICK) for c in correctors]
                one["xy"[plane]] = [[round(float(r), 6) for r in row] for row in np.array(columns).T]
            result.setdefault(word, {})[machine_word] = one
            print(word, machine_word, tunes)
    Path(sys.argv[1]).write_text(json.dumps(result) + "\n")


if __name__ == "__main__":
    main()
