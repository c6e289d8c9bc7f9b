"""Two rings written by the codes themselves, for `orbitcal import`: pyAT (JSON and MAT-file), MAD-X, Xsuite and PALS.

Octave, where it is installed, and hdf5storage write pyAT's MAT-file again: compressed, and as level 7.3 of Matlab, which is HDF5.

`twelve_cells` is the ring of twelve_cells.py; recordings/measured/imports holds its files. `odd` has what conventions differ in: dipoles
with gradients, unlike pole faces and soft edges, rectangular ones, sextupoles, correctors with a length.

    python3 import_lattices.py OUT     # OUT/twelve-cells.{at.json,at.mat,octave.mat,tfs,xsuite.json,pals.yaml}, response.h5, values.{octave,v73}.mat
"""

import contextlib
import io
import shutil
import subprocess
import sys
from pathlib import Path

import h5py
import hdf5storage
import numpy as np
import scipy.io

with contextlib.redirect_stdout(io.StringIO()):  # a word on plotting, which is not used
    import at

import xtrack
import yaml
from cpymad.madx import Madx

CELLS = 12
ANGLE = 2 * np.pi / CELLS
COLUMNS = "name,keyword,s,l,angle,k0l,k1l,k1sl,k2l,k3l,e1,e2,fint,fintx,hgap,tilt,ksi,freq,harmon"
ENERGY, HARMONIC = 1.5, 64


def twelve_cells():
    """Elements in beam order: name, kind, and MAD's attributes."""
    for cell in range(CELLS):
        yield "bpm", "monitor", {}
        yield "l1", "drift", dict(l=0.4)
        yield "qf", "quadrupole", dict(l=0.3, k1=4.0)
        yield "cor", "kicker", dict(l=0.2)
        yield "b", "sbend", dict(l=1.2, angle=ANGLE, e1=ANGLE / 2, e2=ANGLE / 2)
        if cell % 3 == 0:
            yield "sd", "drift", dict(l=0.2)
        yield "qd", "quadrupole", dict(l=0.3, k1=-3.0)
        yield ("l2", "drift", dict(l=0.6)) if cell % 3 == 0 else ("l3", "drift", dict(l=0.8))


def odd():
    """Gradients, unlike faces and soft edges in dipoles, of sector and rectangular ones; sextupoles."""
    for cell in range(CELLS):
        yield "bpm", "monitor", {}
        yield "l1", "drift", dict(l=0.3)
        yield "sx", "sextupole", dict(l=0.1, k2=5.0)
        yield "qf", "quadrupole", dict(l=0.3, k1=4.0)
        yield "cor", "kicker", dict(l=0.2)
        if cell % 2:
            yield "b1", "sbend", dict(l=1.2, angle=ANGLE, e1=0.2, e2=0.3, k1=-0.05, fint=0.5, hgap=0.02)
        else:
            yield "b2", "rbend", dict(l=1.19, angle=ANGLE, e1=0.01, e2=-0.02, k1=0.05, fint=0.4, hgap=0.015)
        yield "qd", "quadrupole", dict(l=0.3, k1=-3.1)
        yield "l3", "drift", dict(l=0.8)


RINGS = {"twelve-cells": twelve_cells, "odd": odd}
SUFFIXES = {"at": ".at.json", "mat": ".at.mat", "octave": ".octave.mat", "v73": ".v73.mat", "madx": ".tfs", "xsuite": ".xsuite.json", "pals": ".pals.yaml"}


def madx(elements):
    """MAD-X with the ring as its sequence `ring`; each element has a name of its own."""
    code = Madx(stdout=False)
    code.input(f"option, rbarc=true; beam, particle=electron, energy={ENERGY};")
    names = []
    for number, (name, kind, attributes) in enumerate(elements):
        names.append(f"{name}.{number}")
        code.input(f"{names[-1]}: {kind}" + "".join(f", {k}={v!r}" for k, v in map(plain, attributes.items())) + ";")
    code.input(f"cav: rfcavity, volt=1, lag=0.5, harmon={HARMONIC};")
    code.input(f"ring: line=({', '.join(names)}, cav); use, period=ring;")
    return code


def plain(item):
    return item[0], float(item[1])


def write_madx(elements, path):
    code = madx(elements)
    code.input("set, format='.15g'; select, flag=twiss, clear;")
    code.input(f"select, flag=twiss, column={COLUMNS}; twiss, file='{path}';")
    code.exit()


def write_xsuite(elements, path):
    xsuite(elements).to_json(str(path), indent=None)


def xsuite(elements):
    """Xsuite's own conversion of the MAD-X sequence."""
    code = madx(elements)
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        line = xtrack.Line.from_madx_sequence(code.sequence.ring)
    line.particle_ref = xtrack.Particles(mass0=xtrack.ELECTRON_MASS_EV, q0=-1, energy0=ENERGY * 1e9)
    code.exit()
    return line


def write_at(elements, path):
    at.save_lattice(pyat(elements), str(path))


def write_mat(elements, path):
    at.save_mat(pyat(elements), str(path))


def octave(commands):
    subprocess.run(["octave", "-qf", "--eval", commands], check=True, capture_output=True)


def write_octave(elements, path):
    write_mat(elements, path)
    octave(f"load('{path}'); THERING = RING; save('-v7', '{path}', 'THERING');")


def write_v73(elements, path):
    write_mat(elements, path)
    ring = plain_values(scipy.io.loadmat(path)["RING"])
    path.unlink()  # hdf5storage adds to a file that exists
    hdf5storage.savemat(str(path), {"RING": ring}, format="7.3", oned_as="row")


def plain_values(value):
    """What scipy reads as hdf5storage writes it: text, structs as dictionaries, struct arrays, cells."""
    if value.dtype.kind == "U":
        return str(value[0]) if value.size else ""
    if value.dtype.names:
        items = [{name: plain_values(one[name]) for name in value.dtype.names} for one in value.flat]
        if len(items) == 1:
            return items[0]
        array = np.empty(value.shape, dtype=[(name, object) for name in value.dtype.names])
        array.flat = [tuple(one.values()) for one in items]
        return array
    if value.dtype == object:
        array = np.empty(value.shape, dtype=object)
        for place, one in np.ndenumerate(value):
            array[place] = plain_values(one)
        return array
    return value


def write_values(folder):
    """Values of every kind, by Octave and as level 7.3; the matrix of the twelve cells [m] as pyLOCO measures it."""
    octave(f"""f = inline('a*x'); P = struct('ElemIndex', {{3,4}}, 'Function', f); s = sparse([1 0;0 2]); i8 = int8([1 2;3 4]);
        c = ['ab';'cd']; z = {{}}; e = struct([]); w = 1+2i; b = true; save('-v7', '{folder}/values.octave.mat', 'f', 'P', 's', 'i8', 'c', 'z', 'e', 'w', 'b');""")
    groups = np.empty((1, 2), dtype=[("ElemIndex", object), ("FieldName", object)])
    groups[0, 0], groups[0, 1] = (np.array([[3.0]]), "K"), (np.array([[4.0]]), "PolynomB")
    cells = np.empty((1, 2), dtype=object)
    cells[0, :] = [np.array([[1.0, 2.0]]), "text"]
    (folder / "values.v73.mat").unlink(missing_ok=True)
    values = {"P": groups, "i8": np.array([[1, 2], [3, 4]], dtype=np.int8), "c": cells, "z": np.empty((0, 0)), "s": {"a": np.array([[1.5]])}}
    hdf5storage.savemat(str(folder / "values.v73.mat"), values, format="7.3", oned_as="row")
    matrix = np.loadtxt(folder / "response.txt")
    with h5py.File(folder / "response.h5", "w") as file:
        file.create_dataset("response_matrix", data=matrix / 1e3, compression="gzip")
        file.create_dataset("dkick", data=1e-4)
        for plane, part in zip("xy", np.split(np.loadtxt(folder / "dispersion.csv", delimiter=",", usecols=1), 2)):
            file.create_dataset(f"measured_eta_{plane}", data=part / 1e3)


def pyat(elements):
    """pyAT's ring; names of families, as its users have them."""
    line = [at_element(*one) for one in elements]
    ring = at.Lattice(line, name="ring", energy=ENERGY * 1e9, periodicity=1)
    rf = HARMONIC * at.constants.clight / ring.circumference
    ring.append(at.RFCavity("CAV", 0.0, 1e6, rf, HARMONIC, ENERGY * 1e9))
    return ring


def arc(kind, a):
    """Length of the arc, and the faces against a sector dipole."""
    if kind == "sbend":
        return a["l"], a.get("e1", 0.0), a.get("e2", 0.0)
    half = a["angle"] / 2
    return a["l"] * half / np.sin(half), half + a.get("e1", 0.0), half + a.get("e2", 0.0)


def at_element(name, kind, a):
    name = name.upper()
    match kind:
        case "monitor":
            return at.Monitor(name)
        case "drift":
            return at.Drift(name, a["l"])
        case "quadrupole":
            return at.Quadrupole(name, a["l"], a["k1"], NumIntSteps=20)
        case "sextupole":
            return at.Sextupole(name, a["l"], a["k2"] / 2)
        case "kicker":
            return at.Corrector(name, a["l"], [0.0, 0.0])
        case "sbend" | "rbend":
            length, e1, e2 = arc(kind, a)
            edges = dict(EntranceAngle=e1, ExitAngle=e2)
            if "hgap" in a:
                edges |= dict(FringeInt1=a["fint"], FringeInt2=a["fint"], FullGap=2 * a["hgap"], gK=2 * a["fint"] * a["hgap"])
            return at.Dipole(name, length, a["angle"], a.get("k1", 0.0), NumIntSteps=20, PassMethod="ExactSectorBendPass", **edges)
    raise ValueError(kind)


def write_pals(elements, path):
    """By the text of the standard, written as YAML; `pals-schema` reads it in exports.py's way."""
    begin = {"begin": {"kind": "BeginningEle", "ReferenceP": {"species_ref": "electron", "E_tot_ref": ENERGY * 1e9, "location": "UPSTREAM_END"}}}
    facility, line = [], [begin]
    for number, (name, kind, a) in enumerate(elements):
        line.append(f"{name}_{number}")
        facility.append({line[-1]: pals_element(kind, a)})
    ring = {"ring": {"kind": "BeamLine", "periodic": True, "line": line}}
    whole = {"lattice": {"kind": "Lattice", "branches": ["ring"]}}
    text = yaml.safe_dump({"PALS": {"facility": [*facility, ring, whole, {"use": "lattice"}]}}, sort_keys=False)
    path.write_text(text)


def pals_element(kind, a):
    field = lambda **of: {"MagneticMultipoleP": {k: float(v) for k, v in of.items()}}
    match kind:
        case "monitor":
            return {"kind": "Instrument", "length": 0.0}
        case "drift":
            return {"kind": "Drift", "length": a["l"]}
        case "quadrupole":
            return {"kind": "Quadrupole", "length": a["l"], **field(Kn1=a["k1"])}
        case "sextupole":
            return {"kind": "Sextupole", "length": a["l"], **field(Kn2=a["k2"])}
        case "kicker":
            return {"kind": "Kicker", "length": a["l"], **field(Kn0L=0.0, Ks0L=0.0)}
        case "sbend" | "rbend":
            length, e1, e2 = arc(kind, a)
            edge = a.get("fint", 0.0) * a.get("hgap", 0.0)
            bend = dict(g_ref=a["angle"] / length, e1=e1, e2=e2, edge_int1=edge, edge_int2=edge)
            return {"kind": "SBend", "length": float(length), "BendP": {k: float(v) for k, v in bend.items()}, **field(Kn1=a.get("k1", 0.0))}
    raise ValueError(kind)


WRITERS = {"at": write_at, "mat": write_mat, "octave": write_octave, "v73": write_v73, "madx": write_madx, "xsuite": write_xsuite, "pals": write_pals}


if not shutil.which("octave"):
    del WRITERS["octave"]


def write(ring, code, folder):
    """The file of a ring by a code."""
    path = folder / f"{ring}{SUFFIXES[code]}"
    WRITERS[code](list(RINGS[ring]()), path)
    return path


if __name__ == "__main__":
    for code in WRITERS.keys() - {"v73"}:
        write("twelve-cells", code, Path(sys.argv[1]))
    write_values(Path(sys.argv[1]))
