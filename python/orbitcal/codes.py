"""Lattices of other codes in memory, by the files that those codes themselves write and read."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import at
    import xtrack


def text_of_pyat(lattice: at.Lattice) -> str:
    """What `at.save_lattice` writes of a lattice."""
    import at

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ring.json"
        at.save_lattice(lattice, str(path))
        return path.read_text()


def pyat_of_text(text: str) -> at.Lattice:
    """The lattice of such a file."""
    import at

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ring.json"
        path.write_text(text)
        return at.load_lattice(str(path))


def text_of_xsuite(line: xtrack.Line) -> str:
    """What `line.to_json` writes of a line."""
    import xobjects

    return json.dumps(line.to_dict(), cls=xobjects.JEncoder)


def xsuite_of_text(text: str) -> xtrack.Line:
    """The line of such a file."""
    import xtrack

    return xtrack.Line.from_dict(json.loads(text))


def name_of(lattice: Any) -> str:
    """Name of a lattice, if it has one."""
    name = getattr(lattice, "name", None)
    return name if isinstance(name, str) and name else "ring"
