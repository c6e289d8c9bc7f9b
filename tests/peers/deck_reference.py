"""Tunes and orbit response of the Booster of the laboratory's deck by pyAT and MAD-X, for tests/golden/reference-deck.json.

24 monitor places x 24 correctors of each plane, half the difference of the closed orbits at +-1 urad over the kick: with sextupoles in
the dipoles, small kicks are what the linear response is the limit of. Strengths are worked out here from the read-backs and the law in
machines/booster-deck.json, apart from the program's own code.

    python tests/peers/deck_reference.py tests/golden/reference-deck.json     (numpy, accelerator-toolbox, cpymad)
"""

import json
import sys
from pathlib import Path

import numpy as np
from cpymad.madx import Madx
from pyat_response import response, ring_of

ROOT = Path(__file__).resolve().parents[2]
KICK = 1e-6  # rad
SLICES = 40  # of a magnet
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
    """Tunes, and the response of x to H and of y to V correctors."""
    kinetic = float(np.hypot(momentum, MASS)) - MASS
    machine = {"elements": elements, "k1": {}, "circumference_m": circumference, "reference": {"kinetic_energy_GeV": kinetic}}
    ring, monitors, correctors = ring_of(machine, SLICES)
    x, y = response(ring, monitors, correctors, KICK)
    return [float(4 + q) for q in ring.get_tune()[:2]], [x[:24, :24], y[24:, 24:]]


def by_madx(elements, momentum, circumference):
    """The same."""
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

    def of_plane(plane):
        names = lambda sort: [e["name"] for e in elements if e["type"] == sort and e["plane"] == "HV"[plane]]
        swing = lambda c: orbit(c, plane, KICK, names("bpm")) - orbit(c, plane, -KICK, names("bpm"))
        return np.array([swing(c) / (2 * KICK) for c in names("corrector")]).T

    return [float(tunes.q1), float(tunes.q2)], [of_plane(0), of_plane(1)]


def main():
    machine = json.loads((ROOT / "machines/booster-deck.json").read_text())
    elements, momentum = powered(machine)
    vars_of = {"design": {}, "paper": json.loads((ROOT / "recordings/paper-vars/truth.json").read_text())["vars"]}
    result = {}
    for word, make in [("pyat", by_pyat), ("madx", by_madx)]:
        for machine_word, factors in vars_of.items():
            scaled = [dict(e) for e in elements]
            for e in scaled:
                if e["type"] == "quadrupole":
                    e["k1"] *= factors.get(e["name"][3:], 1.0)
            tunes, planes = make(scaled, momentum, machine["circumference_m"])
            rows = lambda matrix: [[round(float(r), 6) for r in row] for row in matrix]
            one = {"tunes": tunes, "x": rows(planes[0]), "y": rows(planes[1])}
            result.setdefault(word, {})[machine_word] = one
            print(word, machine_word, tunes)
    Path(sys.argv[1]).write_text(json.dumps(result) + "\n")


if __name__ == "__main__":
    main()
