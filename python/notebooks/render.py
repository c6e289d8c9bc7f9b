"""Execute the notebooks and render them into docs/python, figures beside them.

Usage: render.py [NAME ...]; all of them without names
"""

import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbconvert import MarkdownExporter
from traitlets.config import Config

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
TO = ROOT / "docs/python"
# one form of each output: the figure where there is one, else text
FORMS = ["image/png", "text/markdown", "text/plain"]


def executed(name):
    """The notebook, executed in the repository's root."""
    notebook = nbformat.read(HERE / f"{name}.ipynb", as_version=4)
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(ROOT)}}).execute()
    return notebook


def without_warnings(notebook):
    """Warnings of other libraries name folders of this machine."""
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = [one for one in cell.outputs if one.get("name") != "stderr"]
    return notebook


def render(name):
    """Write its page and figures."""
    config = Config()
    config.NbConvertBase.display_data_priority = FORMS
    notebook = without_warnings(executed(name))
    exporter = MarkdownExporter(config=config)
    body, resources = exporter.from_notebook_node(notebook, {"unique_key": name, "output_files_dir": "figures"})
    for old in (TO / "figures").glob(f"{name}_*.png"):
        old.unlink()
    for file, data in resources.get("outputs", {}).items():
        (TO / file).parent.mkdir(parents=True, exist_ok=True)
        (TO / file).write_bytes(data)
    text = "\n".join(line.rstrip() for line in body.splitlines()).strip() + "\n"
    (TO / f"{name}.md").write_text(text)


if __name__ == "__main__":
    for name in sys.argv[1:] or sorted(path.stem for path in HERE.glob("*.ipynb")):
        render(name)
