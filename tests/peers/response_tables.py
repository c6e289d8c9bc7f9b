"""Write the response matrix of recordings/measured/imports as pyAML and as elegant do.

    python response_tables.py recordings/measured/imports

Needs accelerator-middle-layer (pyAML), soliday-sdds (Argonne's own library) and PyYAML. The x plane is in ASCII, y in binary; numbers have six digits.
"""
import csv
import json
import sys
from dataclasses import asdict
from pathlib import Path

import sdds
import yaml
from pyaml.tuning_tools.orbit_response_matrix_data import OrbitResponseMatrixData

KICK = {"x": 0.2e-3, "y": 0.15e-3}  # rad that a column of response.csv belongs to
STEP = 2000.0  # Hz of dispersion.csv
PLANE = {"x": "H", "y": "V"}
WORD = {"x": "horizontal", "y": "vertical"}


def table(path):
    """Names of lines, names of columns, numbers."""
    head, *rows = csv.reader(path.open())
    return [row[0] for row in rows], head[1:], [[float(value) for value in row[1:]] for row in rows]


def rounded(value):
    return float(f"{value:.6g}")


def pyaml(folder, lines, columns, matrix, dispersion):
    data = OrbitResponseMatrixData(
        matrix=matrix, observable_names=[name[2:] for name in lines], variable_names=[name[2:] for name in columns],
        rf_response=dispersion, observable_planes=[PLANE[name[0]] for name in lines], variable_planes=[PLANE[name[0]] for name in columns])
    saved = {"type": "pyaml.tuning_tools.orbit_response_matrix_data"} | asdict(data)
    json.dump(saved, (folder / "response.pyaml.json").open("w"), indent=1)
    yaml.safe_dump(saved, (folder / "response.pyaml.yaml").open("w"), default_flow_style=None, width=1000)


def elegant(path, mode, plane, lines, columns, matrix):
    """Parameters and columns of elegant's `correction_matrix_output`."""
    rows, places = ([at for at, name in enumerate(names) if name[0] == plane] for names in (lines, columns))
    called = lambda name: name[2:].replace("[", "#").replace("]", "")
    file = sdds.SDDS(0)
    file.mode = mode
    file.setDescription(f"{WORD[plane]}-plane response matrix for beamline RING of lattice ring.lte", f"{WORD[plane]}-plane variable-path-length response matrix")
    file.defineParameter("CorrectionMatrixType", "", "", "correction matrix type", "", sdds.SDDS_STRING, "Response")
    file.defineParameter("Stage", "", "", "Simulation stage", "", sdds.SDDS_STRING, "")
    file.defineColumn("BPMName", "", "", "beam-position-monitor name", "", sdds.SDDS_STRING, 0)
    file.defineColumn("s", "", "m", "beam-position-monitor location", "", sdds.SDDS_DOUBLE, 0)
    for column in places:
        file.defineColumn(called(columns[column]), "", "m/rad", f"response to {called(columns[column])}.KICK", "", sdds.SDDS_DOUBLE, 0)
    file.setParameterValueList("CorrectionMatrixType", ["Response"])
    file.setParameterValueList("Stage", ["tune corrected"])
    file.setColumnValueLists("BPMName", [[called(lines[row]) for row in rows]])
    file.setColumnValueLists("s", [[3.2 * at for at in range(len(rows))]])
    for column in places:
        file.setColumnValueLists(called(columns[column]), [[matrix[row][column] for row in rows]])
    file.save(str(path))


def main(folder):
    lines, columns, orbits = table(folder / "response.csv")
    matrix = [[rounded(1e-3 * value / KICK[name[0]]) for name, value in zip(columns, row)] for row in orbits]
    orbit = {row[0]: float(row[1]) for row in csv.reader((folder / "dispersion.csv").open()) if row[0]}
    pyaml(folder, lines, columns, matrix, [rounded(1e-3 * orbit[name] / STEP) for name in lines])
    elegant(folder / "response-x.sdds", sdds.SDDS_ASCII, "x", lines, columns, matrix)
    elegant(folder / "response-y.sdds", sdds.SDDS_BINARY, "y", lines, columns, matrix)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
