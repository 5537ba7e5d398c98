"""The lines of docs/simulators.md load and move a twin."""

import re
from pathlib import Path

import numpy as np
import pytest
from test_clearance import cabinet
from test_engines import write

from p2gs.export.clearance import clear_links

PAGE = Path(__file__).parents[2] / "docs" / "simulators.md"


def snippet(title: str) -> str:
    section = PAGE.read_text().split(f"## {title}\n")[1].split("\n## ")[0]
    return re.search(r"```python\n(.*?)```", section, re.S).group(1)


@pytest.mark.parametrize("title, package", [("MuJoCo", "mujoco"), ("PyBullet", "pybullet")])
def test_the_lines_run(title, package, tmp_path, monkeypatch):
    pytest.importorskip(package, reason=f"{package} is not installed (pip install p2gs[validate])")
    write(clear_links(cabinet()).links, tmp_path)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile(snippet(title), f"{title} in docs/simulators.md", "exec"), names)
    if title == "MuJoCo":
        want = names["model"].jnt_range.mean(axis=1)
        assert np.allclose(names["data"].qpos, want, atol=0.01) and names["data"].time > 0
    else:
        p, twin = names["p"], names["twin"]
        assert p.getNumJoints(twin) == 2
        p.resetJointState(twin, 1, 0.1)
        p.stepSimulation()
        assert p.getJointState(twin, 1)[0] == pytest.approx(0.1, abs=0.01)
        p.disconnect()
