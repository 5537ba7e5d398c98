"""A joint followed on beyond what was photographed: a door stops at its frame and at a wall, a drawer at the back,
nothing stops in air."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from toy import box, gaussians_of, joint_prismatic, joint_revolute, panel

from p2gs.motion.joint_range import FULL_TURN, Obstacles, extend_ranges, moved, passed
from p2gs.types import ArticulatedObject, GaussianTensors, Part

GREY = (0.5, 0.5, 0.5)


def cabinet(joint, moving, fixed, open_by=0.0):
    """A twin of a cabinet shell plus ``fixed`` panels and one part; the part's panels are given shut, the start state
    is ``open_by``."""
    shell = box((-0.5, -0.4, -0.5), (0.5, 0.4, 0.5), GREY, skip=("-y",)) + fixed
    sets = [gaussians_of(p, 0) for p in (shell, moving)]
    ids = torch.cat([torch.full((len(g),), k, dtype=torch.int64) for k, g in enumerate(sets)])
    g = GaussianTensors.cat(sets)
    if open_by:
        rows = ids == 1
        g.means[rows] = torch.tensor(moved(joint, g.means[rows].double().numpy(), open_by), dtype=torch.float32)
    return ArticulatedObject(g, ids, [Part(0), Part(1, joint)], 0.0)


def frame():
    """Strips in the plane of the opening, facing the door."""
    sides = [panel((x, -0.4, -0.5), (0.2, 0, 0), (0, 0, 1), GREY) for x in (-0.5, 0.3)]
    return [*sides, panel((-0.5, -0.4, 0.3), (1, 0, 0), (0, 0, 0.2), GREY)]


def door(lo=-0.48, hi=0.48):
    return box((-0.49, -0.46, lo), (0.49, -0.42, hi), GREY)


def test_a_door_stops_at_its_frame_when_closing_and_at_a_wall_when_opening():
    joint = joint_revolute((0.0, 0.0, 1.0), (-0.5, -0.44, 0.0), -50.0)  # start: open by 30, end: by 80
    wall = panel((-0.9, -1.6, -0.5), (0, 1.2, 0), (0, 0, 1), GREY)
    free = cabinet(joint, door(), frame(), -30.0)
    blocked = cabinet(joint, door(), frame() + [wall], -30.0)
    (_, a), (_, b) = extend_ranges(free), extend_ranges(blocked)
    assert a.joint.limits[1] == pytest.approx(30.0, abs=5.0) and b.joint.limits[1] == a.joint.limits[1]
    touches = math.degrees(math.acos(-0.4 / 0.99))  # where the rim meets the wall
    assert -b.joint.limits[0] + 30 == pytest.approx(touches, abs=5.0)
    assert a.joint.limits[0] < b.joint.limits[0] - 10
    assert replace(a.joint, limits=joint.limits) == joint, "nothing but the limits changes"


def test_a_door_without_frame_closes_further_than_one_with():
    joint = joint_revolute((0.0, 0.0, 1.0), (-0.5, -0.44, 0.0), -50.0)
    small = box((-0.49, -0.46, -0.42), (0.42, -0.42, 0.42), GREY)  # meets no edge of the shell on its way in
    closed = [extend_ranges(cabinet(joint, small, f, -30.0))[1].joint.limits[1] for f in ([], frame())]
    assert closed[1] < 36 and closed[0] > closed[1] + 5


def test_a_drawer_stops_at_the_back_and_leaves_in_front():
    joint = joint_prismatic((0.0, -1.0, 0.0), (0.0, 0.0, 0.0), 0.2)
    drawer = box((-0.3, -0.45, -0.2), (0.3, 0.3, 0.2), GREY, skip=("+z",))
    (_, part) = extend_ranges(cabinet(joint, drawer, [], 0.1))
    assert part.joint.limits[0] == pytest.approx(-0.2, abs=0.05), "0.1 to shut, 0.1 from there to the back wall"
    assert part.joint.limits[1] > 1.0, "nothing stands in front: as far as the object is large"


def test_sliding_along_a_wall_is_no_contact():
    wall = Obstacles(np.array([[0.0, 0.1 * i, 0.0] for i in range(20)]), np.tile([1.0, 0, 0], (20, 1)), 0.1)
    before = np.array([[0.02, 0.0, 0.0]])
    assert len(passed(before, before + [0, 0.5, 0], wall, 0.1)) == 0
    assert len(passed(before, before - [0.05, 0, 0], wall, 0.1)) > 0
    assert len(passed(before, before + [0.05, 0, 0], wall, 0.1)) == 0, "away from it"


def test_a_part_alone_turns_freely_and_a_tiny_one_keeps_what_was_seen():
    joint = joint_revolute((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 40.0)
    far = [panel((5.0, 0, 0), (0.5, 0, 0), (0, 0, 0.5), GREY)]
    g = [gaussians_of(p, 0) for p in (far, door())]
    ids = torch.cat([torch.full((len(x),), k, dtype=torch.int64) for k, x in enumerate(g)])
    twin = ArticulatedObject(GaussianTensors.cat(g), ids, [Part(0), Part(1, joint)], 0.0)
    assert extend_ranges(twin)[1].joint.limits == (-FULL_TURN, FULL_TURN)
    few = ArticulatedObject(twin.gaussians, torch.zeros_like(ids), twin.parts, 0.0)
    assert extend_ranges(few)[1].joint.limits == joint.limits


def test_export_writes_the_extended_limits_and_leaves_the_twin(tmp_path):
    """`p2gs export --extend-range` in the URDF; twin.json keeps what was observed."""
    import xml.etree.ElementTree as ElementTree

    import trimesh

    from p2gs.cli import main
    from p2gs.gaussians.splat_ply import write_splat_ply
    from p2gs.gaussians.twin_json import write_twin_json
    from p2gs.ops.mesh import Mesh
    from p2gs.surface.mesh import write_mesh

    joint = joint_prismatic((0.0, -1.0, 0.0), (0.0, 0.0, 0.0), 0.2)
    twin = cabinet(joint, box((-0.3, -0.45, -0.2), (0.3, 0.3, 0.2), GREY, skip=("+z",)), [], 0.1)
    write_splat_ply(tmp_path / "splats" / "canonical.ply", twin.gaussians, twin.part_ids)
    write_twin_json(twin, tmp_path / "twin.json")
    solid = trimesh.creation.box((0.6, 0.6, 0.4)).subdivide_to_size(0.1)
    corners, faces = np.asarray(solid.vertices), np.asarray(solid.faces)
    wall = corners * [1, 1 / 3, 1] + [0, 0.6, 0]  # 0.2 behind the drawer, which nothing holds in front
    for state in ("start", "end"):
        (tmp_path / "meshes" / state).mkdir(parents=True)
        for k in (0, 1):
            write_mesh(
                tmp_path / "meshes" / state / f"part_{k}.ply",
                Mesh((wall, corners)[k], faces, np.zeros((len(corners), 3), np.uint8)),
            )
    before = (tmp_path / "twin.json").read_bytes()

    def limits(*words):
        assert main(["export", str(tmp_path), "--format", "urdf", *words]) == 0
        found = ElementTree.parse(tmp_path / "twin.urdf").find(".//joint/limit")
        return float(found.get("lower")), float(found.get("upper"))

    assert limits() == pytest.approx((0.0, 0.2))
    lower, upper = limits("--extend-range")
    assert lower == pytest.approx(-0.2, abs=0.05) and upper == pytest.approx(0.2)
    assert (tmp_path / "twin.json").read_bytes() == before
