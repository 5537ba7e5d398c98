"""The notebooks in examples/ run from their first cell to their last, without Jupyter."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

REPO = Path(__file__).parents[2]
SAID = {  # what a run of each prints, and the twin that it makes
    "quickstart": ("articulation: runs again: phases.articulation.losses.contact", "twin"),
    "extend": ("articulation: runs again: phases.articulation.losses.small", "mine"),
}


def test_every_notebook_is_run():
    assert {p.stem for p in (REPO / "examples").glob("*.ipynb")} == set(SAID)


@pytest.mark.parametrize("name", SAID)
def test_every_cell_runs(name, tmp_path):
    notebook = json.loads((REPO / "examples" / f"{name}.ipynb").read_text())
    lines = []
    for cell in (c for c in notebook["cells"] if c["cell_type"] == "code"):
        assert cell["outputs"] == [] and cell["execution_count"] is None  # as committed: without results
        for statement in ast.parse("".join(cell["source"])).body:
            text = ast.unparse(statement)
            lines.append(f"assert {text} == 0, {text!r}" if text.startswith("main(") else text)
    (tmp_path / "cells.py").write_text("\n".join(lines))
    environment = {**os.environ, "OMP_WAIT_POLICY": "passive", "PYTHONPATH": str(REPO)}
    done = subprocess.run(
        [sys.executable, "cells.py"], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
    said, twin = SAID[name]
    assert said in done.stdout, done.stdout
    assert (tmp_path / twin / "twin.json").is_file()
