"""The engines' checks pass on a twin with room, and fail on one whose joint is blocked or drifts."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from test_clearance import block, cabinet, link, slide

from p2gs.app import run
from p2gs.export.asset import Asset
from p2gs.export.checks.check import check_folder
from p2gs.export.checks.engines import ENGINES, check_engine, installed, joint_facts, run_engine
from p2gs.export.files.mjcf import write_mjcf
from p2gs.export.files.urdf import write_urdf
from p2gs.export.physics.clearance import clear_links
from p2gs.export.physics.convex import decompose
from p2gs.export.physics.inertia import Inertia
from p2gs.ops.mesh import Mesh
from p2gs.types import UserError


def with_looks(links):
    """Each link's first piece also as what it shows, and masses of wood."""
    from p2gs.export.physics.inertia import effective_inertia, inertia_of

    out = []
    for one in links:
        p = one.collision[0]
        inertia: Inertia = inertia_of(one.collision, 300.0)
        joint = one.joint
        if joint is not None:
            weight = inertia.mass if joint.type == "prismatic" else effective_inertia(inertia, joint.axis)
            joint = replace(joint, damping=2 * weight)
        visual = Mesh(p.vertices, p.faces, np.full((len(p.vertices), 3), 128, np.uint8))
        out.append(replace(one, visual=visual, inertia=inertia, joint=joint))
    return out


def write(links, out):
    asset = Asset("cabinet", with_looks(links), "z")
    write_urdf(asset, out)
    write_mjcf(asset, out)
    return out


@pytest.mark.parametrize("name", ENGINES)
def test_joints_with_room_reach_both_limits_and_lie_still(name, tmp_path):
    if not installed(name):
        pytest.skip(f"{name} is not installed (pip install p2gs[validate])")
    result = check_engine(name, write(clear_links(cabinet()).links, tmp_path))
    assert result.problems == [] and set(result.reached) == {"joint_1", "joint_2"}


@pytest.mark.parametrize("name", ["mujoco", "pybullet"])  # SAPIEN does not let a part collide with what it hangs on
def test_a_wall_in_the_way_is_found(name, tmp_path):
    if not installed(name):
        pytest.skip(f"{name} is not installed (pip install p2gs[validate])")
    wall, box = block((-0.3, -0.8, -0.3), (0.3, -0.7, 0.3)), block((-0.2, -0.3, -0.1), (0.2, 0.3, 0.1))
    result = check_engine(name, write([link("base", [wall]), link("part_1", [box], slide((0, -1, 0), 0.8))], tmp_path))
    assert result.reached["joint_1"][1] == pytest.approx(0.5, abs=0.03)  # 0.4 of 0.8
    assert "joint_1 moves from 0 to 5" in result.problems[0]


@pytest.mark.parametrize("name", [n for n in ENGINES if installed(n)])
def test_another_part_in_the_way_is_found(name, tmp_path):
    """It is held where it was photographed."""
    floor, box = block((-2, -2, -9), (2, 2, -8.9)), block((-0.2, -0.3, -0.1), (0.2, 0.3, 0.1))
    near = block((-0.3, -0.8, -0.1), (0.3, -0.7, 0.1))
    links = [
        link("base", [floor]),
        link("part_1", [box], slide((0, -1, 0), 0.8)),
        link("part_2", [near], slide((0, -1, 0), 0.8)),
    ]
    folder = write(links, tmp_path)
    facts = [replace(f, end=0.0) for f in joint_facts(folder / "twin.urdf")]  # with no other recorded state
    reached = run_engine(name, ENGINES[name](folder), facts).reached["joint_1"]
    assert reached[1] == pytest.approx(0.5, abs=0.05)  # MuJoCo's contacts are soft


@pytest.mark.parametrize("name", [n for n in ENGINES if installed(n)])
def test_a_joint_that_has_room_only_where_one_other_is_open_and_one_shut_is_found_free(name, tmp_path):
    """The second part stands in the first one's way at the start, the third at the end."""
    floor, box = block((-2, -2, -9), (2, 2, -8.9)), block((-0.2, -0.3, -0.1), (0.2, 0.3, 0.1))
    near, far = block((-0.2, -0.8, -0.1), (0.2, -0.7, 0.1)), block((1.3, -0.8, -0.1), (1.7, -0.7, 0.1))
    parts = [(box, slide((0, -1, 0), 0.8)), (near, slide((-1, 0, 0), 1.5)), (far, slide((-1, 0, 0), 1.5))]
    links = [link("base", [floor]), *(link(f"part_{k}", [piece], joint) for k, (piece, joint) in enumerate(parts, 1))]
    reached = check_engine(name, write(links, tmp_path)).reached["joint_1"]
    assert reached[0] < 0.02 and reached[1] > 0.98


@pytest.mark.parametrize("name", ["mujoco", "pybullet"])
def test_what_slides_down_is_found(name, tmp_path):
    if not installed(name):
        pytest.skip(f"{name} is not installed (pip install p2gs[validate])")
    floor, box = block((-2, -2, -9), (2, 2, -8.9)), block((-0.2, -0.3, -0.1), (0.2, 0.3, 0.1))
    result = check_engine(
        name, write([link("base", [floor]), link("part_1", [box], slide((0, 0, -1), 30.0))], tmp_path)
    )
    assert result.speed[0] > 1 and any("still moves" in p for p in result.problems)


def test_the_command_prints_a_table_and_says_by_its_exit_code_whether_all_is_well(tmp_path, capsys):
    (tmp_path / "twin.json").write_text("{}")
    assert run(["export", str(tmp_path), "--check"]) == 2 and "has no twin.urdf to check" in capsys.readouterr().err
    write(clear_links(cabinet()).links, tmp_path)
    assert run(["export", str(tmp_path), "--check"]) == 0
    told = capsys.readouterr().out
    assert "MuJoCo" in told and " 2 joints" in told
    (tmp_path / "twin.xml").write_text("<mujoco><body/></mujoco>")
    assert run(["export", str(tmp_path), "--check"]) == 1 and "is not there" in capsys.readouterr().out
    (tmp_path / "twin.xml").write_text("<mujoco>")
    assert run(["export", str(tmp_path), "--check"]) == 2 and "not readable XML" in capsys.readouterr().err
    shutil.rmtree(tmp_path / "assets")
    (tmp_path / "twin.xml").write_text('<mujoco><option gravity="0 -9.81 0"/></mujoco>')
    with pytest.raises(UserError, match="--up z"):
        check_folder(tmp_path)


@pytest.mark.parametrize("lid", [False, True])
def test_a_ball_dropped_into_an_open_drawer_stays_in_it(lid, tmp_path):
    """The drawer's pieces are made of points on its surface, as exports make them; a lid over it is what the test must
    notice."""
    import mujoco

    lo, hi = np.array([0.05, -0.4, -0.2]), np.array([0.45, 0.3, 0.1])
    rng = np.random.default_rng(0)
    points = lo + rng.random((30000, 3)) * (hi - lo)
    side = rng.integers(0, 6 if lid else 5, len(points))  # the sixth side is the upper one
    points[np.arange(len(points)), side % 3] = np.where(side[:, None] >= 3, hi, lo)[np.arange(len(points)), side % 3]
    drawer = link("part_1", decompose(points), slide((0, -1, 0), 0.5))
    base = link("base", [block((-0.5, -0.4, -0.5), (0.5, 0.4, -0.45))])
    write(clear_links([base, drawer]).links, tmp_path)
    spec = mujoco.MjSpec.from_file(str(tmp_path / "twin.xml"))
    ball = spec.worldbody.add_body(name="ball", pos=[0.25, -0.65, 0.2])
    ball.add_freejoint()
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.04, 0, 0])
    model = spec.compile()
    data = mujoco.MjData(model)
    at, speed = model.joint("joint_1").qposadr[0], model.joint("joint_1").dofadr[0]
    for _ in range(1000):
        data.qpos[at], data.qvel[speed] = 0.5, 0
        mujoco.mj_step(model, data)
    x, y, z = data.body("ball").xpos
    assert lo[0] < x < hi[0] and lo[1] - 0.5 < y < hi[1] - 0.5 and z > lo[2]
    assert (z > hi[2]) == lid
