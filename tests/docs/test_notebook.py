"""examples/quickstart.ipynb runs from its first cell to its last, without Jupyter."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

REPO = Path(__file__).parents[2]
NOTEBOOK = REPO / "examples" / "quickstart.ipynb"


def test_every_cell_runs(tmp_path):
    cells = [c for c in json.loads(NOTEBOOK.read_text())["cells"] if c["cell_type"] == "code"]
    lines = []
    for cell in cells:
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
    assert "articulation: runs again: phases.articulation.losses.contact" in done.stdout, done.stdout
    assert (tmp_path / "twin" / "twin.json").is_file()
