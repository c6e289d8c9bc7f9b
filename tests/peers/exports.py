"""Open every export of `orbitcal export` in the code it is for, and compare tunes and orbit responses with orbitcal's own.

MAD-X (PyPI: cpymad), pyAT (accelerator-toolbox), Xsuite (xtrack) open their files. `pals-schema` validates the PALS file,
whose elements are then built in pyAT by the standard's conventions. Bmad is not on PyPI: its file is parsed by the syntax
and attributes of the Bmad manual and built in pyAT too, which checks values and signs and not Bmad's own parser.

Usage: exports.py ORBITCAL [--report FILE.json]; one line a ring and format, exit status 1 beyond the tolerances.
"""

import argparse
import contextlib
import io
import json
import re
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np

with contextlib.redirect_stdout(io.StringIO()):  # a word on plotting, which is not used
    import at

import pals
import xtrack
from cpymad.madx import Madx

warnings.filterwarnings("ignore", message="AT tracking still assumes beta==1")  # matters at fixed frequency only
warnings.filterwarnings("ignore", message="The .* element is marked as 'Under Construction'")  # so is the standard

ROOT = Path(__file__).resolve().parents[2]
RINGS = {"ten-cells": ROOT / "recordings/ten-cells/ring.json", "odd": ROOT / "tests/golden/rings/odd.json",
         "shifted": ROOT / "tests/golden/rings/shifted.json"}
KICK = 2e-6  # rad: orbits small enough to be linear, even in the sextupoles here, and 1e-12 m is 5e-7 m/rad
at.DConstant.XYStep = 1e-6  # m: the 3e-8 that pyAT takes of itself leaves up to 4e-7 of rounding in a tune
TUNE, RESPONSE = 1e-6, 1e-4  # tolerances [1, m/rad]


class Case:
    """A ring with strengths and findings: its export and the numbers of orbitcal."""

    def __init__(self, orbitcal, folder, name, machine, strengths, findings=()):
        self.orbitcal, self.folder, self.name, self.machine = orbitcal, folder, name, machine
        self.findings = list(findings)
        names = [var["name"] for var in strengths]
        assert len(set(names)) == len(names)
        self.result, self.vars = folder / f"{name}.json", folder / f"{name}-vars.json"
        found = [dict(kind=k, at=p, amplitude=a, probability=1.0, sentence=f"{k} at {p}") for k, p, a in self.findings]
        self.result.write_text(json.dumps(dict(recording=name, vars=strengths, findings=found)))
        self.vars.write_text(json.dumps({var["name"]: var["mean"] for var in strengths}))
        elements = json.loads((machine or ROOT / "machines/booster-deck.json").read_text())["elements"]
        self.monitors = channels(elements, "bpm")
        self.correctors = channels(elements, "corrector")

    def run(self, *arguments):
        machine = ["--machine", self.machine] if self.machine else []
        done = subprocess.run([self.orbitcal, *arguments, *machine], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def own(self, gains):
        """Tunes, and the response of x and y at every monitor; monitors as they should be, correctors with gains or not."""
        left_out = ("bpm_",) if gains else ("bpm_", "corrector_gain", "corrector_polarity")
        effects = [f"{k}@{p}={a}" for k, p, a in self.findings if not k.startswith(left_out)]
        answer = json.loads(self.run("response", "--vars", self.vars, "--json", "-", "--quiet",
                                     *[word for effect in effects for word in ("--effect", effect)]))
        response = [np.array(answer[f"response_{plane}_m_per_rad"]) for plane in "xy"]
        return [answer["qx"], answer["qy"]], response

    def export(self, form, suffix):
        path = self.folder / f"{self.name}{suffix}"
        self.run("export", self.result, "--as", form, "--out", path, "--quiet")
        return path


def channels(elements, kind):
    """Element and plane of all monitors or correctors, horizontal planes first."""
    return [(e["name"], plane) for plane in "HV" for e in elements if e["type"] == kind and plane in e["plane"]]


def response(case, orbit):
    """Half the difference of orbits at plus and minus a kick; `orbit(corrector, plane, kick)` gives x and y at monitors."""
    columns = []
    for name, plane in case.correctors:
        up, down = [np.array(orbit(name, plane, kick)) for kick in (KICK, -KICK)]
        columns.append((up - down) / (2 * KICK))
    both = np.array(columns)  # [corrector][plane][monitor]
    return [both[:, plane, :].T for plane in (0, 1)]


def knob(case, name, plane):
    """The variable of a corrector; with its plane where it has both."""
    both = sum(1 for other, _ in case.correctors if other == name) == 2
    return f"kick_{name}" + (f"_{plane.lower()}" if both else "")


def madx(case):
    code = Madx(stdout=False)
    code.call(str(case.export("madx", ".madx")))
    places = None

    def orbit(name, plane, kick):
        nonlocal places
        code.globals[knob(case, name, plane)] = kick
        table = code.twiss(sequence="ring", tolerance=1e-14)
        code.globals[knob(case, name, plane)] = 0.0
        if places is None:
            rows = {row.split(":")[0].upper(): i for i, row in enumerate(table.name)}
            places = [rows[monitor.upper()] for monitor, _ in case.monitors]
        return table.x[places], table.y[places]

    table = code.twiss(sequence="ring", tolerance=1e-14)
    tunes = [table.summary.q1, table.summary.q2]
    own = case.own(gains=True)
    answer = tunes, response(case, orbit)
    code.exit()
    return own, answer


def xsuite(case):
    line = xtrack.Line.from_json(str(case.export("xsuite", "-xsuite.json")), with_progress=False, verbose=False)
    line.build_tracker()
    twiss = line.twiss4d(co_search_settings={"xtol": 1e-14})
    places = [line.element_names.index(monitor) for monitor, _ in case.monitors]

    def orbit(name, plane, kick):
        line[knob(case, name, plane)] = kick
        start = line.find_closed_orbit(delta0=0, co_search_settings={"xtol": 1e-14})
        line.track(start, turn_by_turn_monitor="ONE_TURN_EBE")
        line[knob(case, name, plane)] = 0.0
        return line.record_last_track.x[0, places], line.record_last_track.y[0, places]

    return case.own(gains=True), ([twiss.qx, twiss.qy], response(case, orbit))


def pyat(case):
    ring = at.load_lattice(str(case.export("at", "-at.json")))
    return of_pyat(case, ring)


def of_pyat(case, ring, axes=None):
    """The answer of a ring in pyAT; `axes`, if given, the kick in x and y of each corrector set to one."""
    ring.disable_6d()
    where = {element.FamName: i for i, element in enumerate(ring)}
    places = [where[monitor] for monitor, _ in case.monitors]
    refpts = sorted(set(places))
    rows = [refpts.index(place) for place in places]

    def orbit(name, plane, kick):
        axis = axes[name, plane] if axes else {"H": (1.0, 0.0), "V": (0.0, 1.0)}[plane]
        corrector = ring[where[name]]
        corrector.KickAngle = [kick * axis[0], kick * axis[1]]
        _, orbits = at.find_orbit4(ring, 0.0, refpts, convergence=1e-12, max_iterations=50)
        corrector.KickAngle = [0.0, 0.0]
        return orbits[rows, 0], orbits[rows, 2]

    tunes = at.get_tune(ring, get_integer=True)
    return case.own(gains=axes is not None), (list(tunes[:2]), response(case, orbit))


def pyat_ring(case, elements, species, energy):
    return at.Lattice(elements, name=case.name, energy=energy, particle=species, periodicity=1)


def aligned(element, dx=0.0, dy=0.0, roll=0.0):
    """Shift, then turn from x to y."""
    if dx or dy:
        element.T1, element.T2 = np.array([-dx, 0, -dy, 0, 0, 0]), np.array([dx, 0, dy, 0, 0, 0])
    if roll:
        turn = np.eye(6)
        c, s = np.cos(roll), np.sin(roll)
        for h, v in ((0, 2), (1, 3)):
            turn[h, h], turn[h, v], turn[v, h], turn[v, v] = c, s, -s, c
        element.R1, element.R2 = turn, turn.T
    return element


def drift(name, length):
    return at.Drift(name, length, PassMethod="ExactDriftPass")


def dipole(name, length, angle, k1, k2, e1, e2, fint, hgap):
    return at.Dipole(name, length, angle, PolynomB=[0.0, k1, k2 / 2], EntranceAngle=e1, ExitAngle=e2, FringeInt1=fint,
                     FringeInt2=fint, FullGap=2 * hgap, gK=2 * fint * hgap, NumIntSteps=20, PassMethod="ExactSectorBendPass")


def quadrupole(name, length, k1):
    return at.Quadrupole(name, length, k1, PassMethod="QuadLinearPass")


def solenoid(name, length, ks):
    return at.Element(name, Length=length, K=ks, PassMethod="SolenoidLinearPass")


def of_pals(case):
    """Validated by `pals-schema`, then built in pyAT."""
    path = case.export("pals", ".pals.json")
    facility = {e.name: e for e in pals.load(str(path)).facility if hasattr(e, "kind")}
    ring = facility[str(facility["lattice"].branches[0])]
    line = [e if hasattr(e, "kind") else facility[str(e)] for e in ring.line]
    reference = line[0].ReferenceP
    elements = [pals_element(e) for e in line[1:]]
    return of_pyat(case, pyat_ring(case, elements, reference.species_ref, reference.E_tot_ref))


def pals_element(e):
    multipoles = dict(e.MagneticMultipoleP.model_dump()) if getattr(e, "MagneticMultipoleP", None) else {}
    k = lambda order, kind="n", integrated="": multipoles.get(f"K{kind}{order}{integrated}", 0.0)
    shift = e.BodyShiftP
    align = dict(dx=shift.x_offset, dy=shift.y_offset, roll=shift.z_rot) if shift else {}
    match e.kind:
        case "Drift":
            return drift(e.name, e.length)
        case "Marker" | "Instrument":
            return at.Marker(e.name)
        case "Kicker":
            kick = [-k(0, "n", "L"), k(0, "s", "L")]
            return aligned(at.Corrector(e.name, e.length, kick, PassMethod="ThinMPolePass", PolynomA=[0.0], PolynomB=[0.0],
                                        MaxOrder=0), **align)
        case "Quadrupole":
            return aligned(quadrupole(e.name, e.length, k(1)), **align)
        case "Sextupole":
            return aligned(at.Sextupole(e.name, e.length, k(2) / 2), **align)
        case "Multipole":
            skew, normal = [[k(n, kind, "L") / f for n, f in enumerate((1, 1, 2, 6))] for kind in "sn"]
            return aligned(at.ThinMultipole(e.name, skew, normal), **align)
        case "Solenoid":
            return aligned(solenoid(e.name, e.length, e.SolenoidP.Ksol), **align)
        case "SBend":
            bend = e.BendP
            assert bend.edge_int1 == bend.edge_int2
            return aligned(dipole(e.name, e.length, bend.g_ref * e.length, k(1), k(2), bend.e1, bend.e2, 0.5,
                                  2 * bend.edge_int1), roll=bend.tilt_ref, **align)
    raise ValueError(e.kind)


# The attributes of the Bmad manual that an export uses, by class.
BMAD = {
    "drift": {"l"}, "marker": set(), "monitor": {"x_gain_err", "y_gain_err", "tilt"},
    "hkicker": set(), "vkicker": set(), "kicker": set(),
    "quadrupole": {"l", "k1", "tilt", "x_offset", "y_offset"},
    "sextupole": {"l", "k2", "tilt", "x_offset", "y_offset"},
    "solenoid": {"l", "ks", "tilt", "x_offset", "y_offset"},
    "ab_multipole": {"b1", "a1", "b2", "b3", "tilt", "x_offset", "y_offset"},
    "sbend": {"l", "g", "k1", "k2", "e1", "e2", "fint", "hgap", "ref_tilt", "x_offset", "y_offset"},
}
NAME = r"[A-Za-z][A-Za-z0-9_.]{0,39}"


def bmad(case):
    """Parsed by the manual's syntax, then built in pyAT; correctors by their overlays."""
    text = case.export("bmad", ".bmad").read_text()
    assert all(len(line) < 500 for line in text.splitlines())
    lines = [line.split("!")[0].rstrip() for line in text.splitlines()]
    statements = re.sub(r"([,({=])\s*\n\s*", r"\1 ", "\n".join(lines)).split("\n")
    parameters, elements, overlays, order = {}, {}, {}, None
    for statement in filter(None, map(str.strip, statements)):
        if found := re.fullmatch(r"parameter\[(\w+)\] = (\S+)", statement):
            parameters[found[1]] = found[2]
        elif found := re.fullmatch(rf"ring: line = \( (.*)\)", statement):
            order = [name.strip() for name in found[1].split(",")]
        elif found := re.fullmatch(rf"({NAME}): overlay = \{{(.*)\}}, var = \{{setting\}}", statement):
            overlays[found[1]] = found[2].split(", ")
        elif found := re.fullmatch(rf"({NAME}): (\w+)((?:, \w+ = [-+.e0-9]+)*)", statement):
            attributes = {k: float(v) for k, v in re.findall(r", (\w+) = ([-+.e0-9]+)", found[3])}
            assert set(attributes) <= BMAD[found[2]], statement
            assert found[1].upper() not in map(str.upper, elements), statement
            elements[found[1]] = (found[2], attributes)
        else:
            assert statement == "use, ring", statement
    assert parameters["geometry"] == "closed" and set(order) == set(elements) and len(order) == len(elements)
    ring = pyat_ring(case, [bmad_element(n, *elements[n]) for n in order], parameters["particle"], float(parameters["e_tot"]))
    return of_pyat(case, ring, {channel: bmad_axis(case, channel, elements, overlays) for channel in case.correctors})


def bmad_axis(case, channel, elements, overlays):
    """The kick in x and y of a corrector whose knob, its overlay or else its own attribute, is set to one."""
    (name, plane), axis = channel, {"H": 0.0, "V": 0.0}
    kind = elements[name][0]
    own = {"H": "hkick", "V": "vkick"}[plane] if kind == "kicker" else "kick"
    for target in overlays.get(knob(case, name, plane), [f"{name}[{own}]: (1.0) * setting"]):
        element, attribute, factor = re.fullmatch(rf"({NAME})\[(\w+)\]: \((\S+)\) \* setting", target).groups()
        assert element == name and attribute in ({"hkick", "vkick"} if kind == "kicker" else {"kick"}), target
        axis[{"hkick": "H", "vkick": "V"}.get(attribute, kind[0].upper())] += float(factor)
    return axis["H"], axis["V"]


def bmad_element(name, kind, a):
    g = lambda word: a.get(word, 0.0)
    align = dict(dx=g("x_offset"), dy=g("y_offset"), roll=g("tilt") or g("ref_tilt"))
    match kind:
        case "drift":
            return drift(name, g("l"))
        case "marker" | "monitor":
            return at.Marker(name)
        case "hkicker" | "vkicker" | "kicker":
            return at.Corrector(name, 0.0, [0.0, 0.0])
        case "quadrupole":
            return aligned(quadrupole(name, g("l"), g("k1")), **align)
        case "sextupole":
            return aligned(at.Sextupole(name, g("l"), g("k2") / 2), **align)
        case "solenoid":
            return aligned(solenoid(name, g("l"), g("ks")), **align)
        case "ab_multipole":
            return aligned(at.ThinMultipole(name, [0, g("a1"), 0, 0], [0, g("b1"), g("b2"), g("b3")]), **align)
        case "sbend":
            return aligned(dipole(name, g("l"), g("g") * g("l"), g("k1"), g("k2"), g("e1"), g("e2"), g("fint"), g("hgap")),
                           **align)
    raise ValueError(kind)


CODES = {"madx": madx, "at": pyat, "xsuite": xsuite, "pals": of_pals, "bmad": bmad}


def scattered(machine, spread=0.01):
    """Strengths of every quadrupole of a machine file, with a fixed scatter."""
    random = np.random.default_rng(7)
    names = [var_name(e["name"]) for e in machine["elements"] if e["type"] == "quadrupole"]
    return [dict(name=name, mean=1 + spread * random.standard_normal()) for name in names]


def var_name(name):
    return name.split("_", 1)[1] if "_" in name else name


def cases(orbitcal, folder):
    fitted = folder / "paper-vars-fit.json"
    done = subprocess.run([orbitcal, "fit", ROOT / "recordings/paper-vars", "--json", fitted, "--quiet"])
    assert done.returncode == 0
    strengths = json.loads(fitted.read_text())["vars"]
    yield Case(orbitcal, folder, "booster", None, strengths)
    yield Case(orbitcal, folder, "booster-findings", None, strengths, [
        ("quad_roll", "D8", 0.012), ("stray_gradient", "SLOT_F6", 0.01), ("stray_skew_gradient", "SLOT_C3", -0.008),
        ("dipole_gradient", "B_C4", 0.009), ("dipole_edge", "B_E2", 0.05), ("sextupole_error", "SX_A1", 2.0),
        ("stray_octupole", "SLOT_D6", 100.0),
        ("corrector_gain", "H_A4", 0.06), ("corrector_roll", "V_D3", 0.05), ("corrector_polarity", "H_B2", 1.0),
        ("bpm_gain", "x_E4", -0.08), ("bpm_roll", "y_C5", 0.04),
    ])
    for name, path in RINGS.items():
        yield Case(orbitcal, folder, name, path, scattered(json.loads(path.read_text())))


def main():
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("orbitcal")
    arguments.add_argument("--only", choices=CODES)
    arguments.add_argument("--report")
    options = arguments.parse_args()
    good, report = True, {}
    with tempfile.TemporaryDirectory() as folder:
        for case in cases(Path(options.orbitcal).resolve(), Path(folder)):
            for code in [options.only] if options.only else CODES:
                (own_tunes, own), (tunes, theirs) = CODES[code](case)
                tune = max(abs(a - b) for a, b in zip(own_tunes, tunes))
                error = max(float(np.abs(a - b).max()) for a, b in zip(own, theirs))
                agrees = tune < TUNE and error < RESPONSE
                good &= agrees
                report.setdefault(case.name, {})[code] = dict(tune=tune, response_m_per_rad=error)
                print(f"{case.name:18} {code:7} tunes {tune:8.1e}  response {error:8.1e} m/rad"
                      f"{'' if agrees else '  BEYOND THE TOLERANCE'}", flush=True)
    if options.report:
        Path(options.report).write_text(json.dumps(report, indent=1) + "\n")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
