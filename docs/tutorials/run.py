"""Runs the tutorials: `python docs/tutorials/run.py [NAME.ipynb …]` keeps their outputs, `--check` does not.

Each runs in a kernel and an empty folder of its own, with Python's warnings as errors. What is kept is code,
text and images: no metadata, no numbers of runs, nothing of the machine.
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
import tempfile
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

HERE = Path(__file__).resolve().parent
STRICT = """
import warnings
warnings.simplefilter("error")
warnings.filterwarnings("ignore", category=PendingDeprecationWarning, module="ipykernel")
warnings.filterwarnings("ignore", "InlineBackend")
"""
"""Runs ahead of the first cell, and is not kept. The two exceptions are Jupyter's own."""
TIMEOUT = 900
"""Seconds of a cell, on a machine that does other things, too."""
KEPT = ("image/jpeg", "image/png", "text/plain")
"""Kinds of outputs, the first of which a cell has is kept."""


def run(path: Path) -> Any:
    """The notebook with the outputs of a run; raises CellExecutionError for a cell that fails."""
    notebook = nbformat.read(path, as_version=4)
    first = nbformat.v4.new_code_cell(STRICT)
    notebook.cells.insert(0, first)
    with tempfile.TemporaryDirectory(prefix="tutorial_") as folder:
        options = {"metadata": {"path": folder}}
        NotebookClient(notebook, timeout=TIMEOUT, kernel_name="python3", resources=options).execute()
    notebook.cells.remove(first)
    return stripped(notebook)


def stripped(notebook: Any) -> Any:
    """The notebook without what differs from machine to machine and from run to run."""
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    for number, cell in enumerate(notebook.cells):
        cell.id, cell.metadata = f"cell-{number:02d}", {}
        if cell.cell_type != "code":
            continue
        cell.execution_count = None
        for output in cell.outputs:
            if "execution_count" in output:
                output.execution_count = None
            if "data" in output:
                kind = next(kind for kind in KEPT if kind in output.data)
                output.data, output.metadata = {kind: output.data[kind]}, {}
    return notebook


def main() -> None:
    """Run those that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("notebooks", nargs="*", type=Path, default=sorted(HERE.glob("*.ipynb")))
    parser.add_argument("--check", action="store_true", help="write nothing")
    args = parser.parse_args()
    os.environ["PYTHONPATH"] = os.pathsep.join([str(HERE.parents[1]), os.environ.get("PYTHONPATH", "")])
    for path in args.notebooks:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        notebook = run(path)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        if not args.check:
            nbformat.write(notebook, path)
        print(f"{path.name}: {seconds:.0f} s of CPU", file=sys.stderr)


if __name__ == "__main__":
    main()
