"""The notebook runs from top to bottom, on a small budget."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.docs
NOTEBOOK = Path(__file__).parents[1] / "examples" / "first_run.ipynb"
EXECUTE = """
import sys
import nbformat
from nbclient import NotebookClient
notebook = nbformat.read(sys.argv[1], as_version=4)
NotebookClient(notebook, timeout=600, kernel_name="python3").execute()
print(sum(bool(cell.get("outputs")) for cell in notebook.cells), "cells have printed something")
"""


def test_the_notebook_runs(tmp_path):
    environment = os.environ | {"STEPS": "1000", "MPLBACKEND": "module://matplotlib_inline.backend_inline"}
    command = [sys.executable, "-c", EXECUTE, str(NOTEBOOK)]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "7 cells have printed something\n"), done.stderr[-2000:]
    assert (tmp_path / "report.html").is_file()
