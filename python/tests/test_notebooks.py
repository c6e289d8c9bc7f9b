"""The notebooks run, and docs/python shows them as they are."""

import sys

import pytest
from conftest import ROOT

sys.path.insert(0, str(ROOT / "python/notebooks"))
from render import TO, executed


@pytest.mark.parametrize("name", ["own-ring", "missing-physics", "live-stream"])
def test_a_notebook_runs_and_is_the_page_in_docs(name):
    """The notebooks assert what they say; a page is rendered anew by `make notebooks`."""
    notebook, page = executed(name), (TO / f"{name}.md").read_text()
    for cell in notebook.cells:
        source = "\n".join(line.rstrip() for line in cell.source.splitlines())
        assert source in page, f"python/notebooks/{name}.ipynb is not docs/python/{name}.md: make notebooks"
    outputs = [one for cell in notebook.cells for one in cell.get("outputs", [])]
    figures = [one for one in outputs if "image/png" in one.get("data", {})]
    drawn = list((TO / "figures").glob(f"{name}_*.png"))
    assert len(figures) == len(drawn) == page.count("![png]") >= 2
