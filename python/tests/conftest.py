"""The repository's rings and recordings."""

import contextlib
import io
import os
import warnings
from pathlib import Path

import pytest

with contextlib.redirect_stdout(io.StringIO()):  # a word on plotting, which is not used
    import at  # noqa: F401

import orbitcal

# step of finite differences [m]: the 3e-8 that pyAT takes of itself leaves up to 4e-7 of rounding in a tune
at.DConstant.XYStep = 1e-6
warnings.filterwarnings("ignore", message="AT tracking still assumes beta==1")  # matters at fixed frequency only

ROOT = Path(os.environ.get("ORBITCAL_ROOT", Path(__file__).parents[2]))
RECORDINGS = ROOT / "recordings"
IMPORTS = RECORDINGS / "measured/imports"


@pytest.fixture(scope="session")
def booster():
    """As its published inference describes it."""
    return orbitcal.Ring(ROOT / "machines/booster.json")


@pytest.fixture(scope="session")
def paper_vars(booster):
    return orbitcal.Recording.read(RECORDINGS / "former/paper-vars", booster)


@pytest.fixture(scope="session")
def fitted(paper_vars):
    return orbitcal.fit(paper_vars)


@pytest.fixture(scope="session")
def twelve_cells():
    """A lattice that pyAT wrote."""
    return at.load_lattice(str(IMPORTS / "twelve-cells.at.json"))
