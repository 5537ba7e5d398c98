"""The lines of docs/simulators load and move a twin."""

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from test_clearance import cabinet
from test_engines import with_looks, write

from p2gs.export.asset import Asset
from p2gs.export.files.usd import write_usd
from p2gs.export.physics.clearance import clear_links

PAGES = Path(__file__).parents[2] / "docs" / "simulators"


def lines_of(page: str) -> str:
    return re.search(r"```python\n(.*?)```", (PAGES / f"{page}.md").read_text(), re.S).group(1)


def run_lines(page: str, lines: str = "") -> dict:
    names: dict = {}
    exec(compile(lines or lines_of(page), f"docs/simulators/{page}.md", "exec"), names)
    return names


@pytest.fixture
def twin(tmp_path, monkeypatch):
    """The working directory has a cabinet's files; middle of both joints' ranges."""
    links = clear_links(cabinet()).links
    write(links, tmp_path)
    monkeypatch.chdir(tmp_path)
    return np.array([(x.joint.lower + x.joint.upper) / 2 for x in links if x.joint is not None])


def test_every_page_has_its_lines_and_an_existing_picture():
    pages = sorted(p.stem for p in PAGES.glob("*.md"))
    assert pages == ["genesis", "isaac", "mujoco", "newton", "pybullet", "sapien"]
    for page in pages:
        pictures = re.findall(r"!\[.*?\]\((.*?)\)", (PAGES / f"{page}.md").read_text())
        assert lines_of(page) and all((PAGES / name).stat().st_size > 5000 for name in pictures)
        assert pictures or page == "isaac"


def test_mujoco(twin):
    pytest.importorskip("mujoco", reason="mujoco is not installed (pip install p2gs[validate])")
    names = run_lines("mujoco")
    assert np.allclose(names["data"].qpos, twin, atol=0.01) and names["data"].time > 0


def test_pybullet(twin):
    pytest.importorskip("pybullet", reason="pybullet is not installed (pip install p2gs[validate])")
    names = run_lines("pybullet")
    p, body = names["p"], names["twin"]
    assert p.getNumJoints(body) == 2
    assert [p.getJointState(body, j)[0] for j in range(2)] == pytest.approx([twin[0], 0.0], abs=0.01)
    p.disconnect()


def test_sapien(twin):
    """Its way without a Vulkan device, as the page says: no renderer, no visuals."""
    pytest.importorskip("sapien", reason="sapien is not installed (pip install p2gs[validate])")
    tree = ET.parse("twin.urdf")
    for element in tree.getroot().findall("link"):
        for visual in element.findall("visual"):
            element.remove(visual)
    tree.write("twin.urdf")
    lines = lines_of("sapien")
    assert (
        "sapien.Scene()" in lines
        and "sapien.Scene([sapien.physx.PhysxCpuSystem()])" in (PAGES / "sapien.md").read_text()
    )
    names = run_lines("sapien", lines.replace("sapien.Scene()", "sapien.Scene([sapien.physx.PhysxCpuSystem()])"))
    assert np.allclose(names["twin"].get_qpos(), twin, atol=0.01)


@pytest.mark.slow
def test_genesis(twin):
    pytest.importorskip("genesis", reason="genesis is not installed (pip install genesis-world)")
    names = run_lines("genesis")
    assert np.allclose(names["twin"].get_dofs_position(), twin, atol=0.01)


@pytest.mark.slow
def test_newton(twin):
    pytest.importorskip("newton", reason="newton is not installed (pip install newton[sim])")
    names = run_lines("newton")
    assert np.allclose(names["after"].joint_q.numpy(), twin, atol=0.01)


def test_isaac(twin, tmp_path, capsys):
    pytest.importorskip("pxr", reason="usd-core is not installed (pip install p2gs[usd])")
    links = clear_links(cabinet()).links
    write_usd(Asset("cabinet", with_looks(links), "z"), tmp_path)
    run_lines("isaac")
    told = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in told] == ["/twin/joint_1", "/twin/joint_2"]
    middles = [(float(line.split()[1]) + float(line.split()[2])) / 2 for line in told]
    units = [np.pi / 180 if x.joint.type == "revolute" else 1.0 for x in links if x.joint is not None]
    assert np.allclose(np.array(middles) * units, twin, atol=1e-5)
