"""URDF, MJCF, GLB and USD of the hand-made cabinet, opened by independent readers and held against twin.json."""

import json
import math
import os
import shutil
import struct

import numpy as np
import pytest
import trimesh
from solids import intersect
from toy import toy_scene, toy_twin

from p2gs.export.asset import load_asset, placement
from p2gs.export.files.glb import glb_bytes
from p2gs.export.formats import EXPORTERS, export_run
from p2gs.export.physics.convex import Piece, decompose, hull
from p2gs.export.physics.inertia import inertia_of
from p2gs.export.run_folder import write_twin
from p2gs.ops.mesh import Mesh
from p2gs.surface.simplify import simplify
from p2gs.surface.tsdf import vertex_normals
from p2gs.types import Similarity, UserError

SIM = Similarity(2.0, (0.2, 0.1, -0.3))


# result folders to hold against the same readers
REAL = [p for p in os.environ.get("P2GS_RUNS", "").split(os.pathsep) if p]


@pytest.fixture(scope="module")
def toy(tmp_path_factory):
    from p2gs.surface.mesh import write_meshes

    folder = tmp_path_factory.mktemp("cabinet")
    write_twin(toy_twin(SIM), folder, toy_scene(SIM, n=12, size=110), media=False)
    write_meshes(folder, resolution=50)
    export_run(folder, ["all"])
    return folder


@pytest.fixture(scope="module", params=["toy", *REAL])
def run(request, tmp_path_factory):
    if request.param == "toy":
        return request.getfixturevalue("toy")
    folder = tmp_path_factory.mktemp("run")
    shutil.copytree(request.param, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("checkpoints", "logs"))
    export_run(folder, ["all"])
    return folder


@pytest.fixture(scope="module")
def joints(run):
    parts = json.loads((run / "twin.json").read_text())["parts"]
    return {p["id"]: p["joint"] for p in parts if p["kind"] == "movable"}


def si(joint):
    return math.radians(joint["motion"]) if joint["type"] == "revolute" else joint["motion"]


def test_collision_pieces_are_made_once_and_only_for_formats_that_hold_them(toy, tmp_path, monkeypatch):
    from p2gs.export import asset

    made = []
    monkeypatch.setattr(asset, "decompose", lambda *a: made.append(1) or decompose(*a))
    export_run(toy, ["glb", "obj", "ply"], tmp_path)
    assert not made
    export_run(toy, ["urdf", "mjcf", "glb"], tmp_path)
    assert len(made) == 3  # a part each
    for name in ("twin.urdf", "twin.xml", "twin.glb"):
        assert (tmp_path / name).read_bytes() == (toy / name).read_bytes()


def test_urdf_opens_in_yourdfpy_and_agrees_with_the_twin(run, joints):
    import yourdfpy

    robot = yourdfpy.URDF.load(str(run / "twin.urdf"))
    assert sorted(robot.actuated_joint_names) == sorted(f"joint_{k}" for k in joints)
    robot.update_cfg({f"joint_{k}": si(j) for k, j in joints.items()})
    for k, joint in joints.items():
        got = robot.joint_map[f"joint_{k}"]
        assert np.allclose(got.axis, joint["axis"], atol=1e-6) and got.type == joint["type"]
        assert (
            np.allclose([got.limit.lower, got.limit.upper], sorted([0, si(joint)]), atol=1e-6)
            and float(got.dynamics.damping) > 0
        )
        start = np.eye(4)
        start[:3, 3] = joint["origin"]
        assert np.allclose(robot.get_transform(f"part_{k}", "base"), np.array(joint["transform"]) @ start, atol=1e-6)
    shape = robot.scene.to_geometry()
    want = trimesh.load(run / "meshes" / "end" / "whole.ply", process=False)
    # the visual meshes stand where the end state's meshes stand
    assert np.allclose(shape.bounds, want.bounds, atol=0.02)
    for link in robot.link_map.values():
        assert link.inertial.mass > 0 and (np.linalg.eigvalsh(link.inertial.inertia) > 0).all()
        assert len(link.collisions) >= 1


def mujoco_pose(model, data, name):
    body = model.body(name).id
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
    return T


@pytest.mark.parametrize("file", ["twin.urdf", "twin.xml"])
def test_both_load_in_mujoco_and_agree_with_the_twin(run, joints, file):
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(run / file))
    data = mujoco.MjData(model)
    for k, joint in joints.items():
        got = model.joint(f"joint_{k}")
        assert np.allclose(got.range, sorted([0, si(joint)]), atol=1e-6)
        data.qpos[got.qposadr[0]] = si(joint)
    mujoco.mj_forward(model, data)
    for k, joint in joints.items():
        start = np.eye(4)
        start[:3, 3] = joint["origin"]
        assert np.allclose(mujoco_pose(model, data, f"part_{k}"), np.array(joint["transform"]) @ start, atol=1e-6)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_mjcf_runs_ten_seconds_under_gravity_and_force_within_its_limits(run, joints, sign):
    """A force that would move each joint through its range in about a second pushes it, first to one end, then to the
    other."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(run / "twin.xml"))
    data = mujoco.MjData(model)
    reached = np.zeros((model.njnt, 2))
    ranges = model.jnt_range.copy()
    span = ranges[:, 1] - ranges[:, 0]
    while data.time < 10:
        data.ctrl[:] = (sign if data.time < 5 else -sign) * 2.0 * model.dof_damping * span
        mujoco.mj_step(model, data)
        assert np.isfinite(data.qpos).all() and np.abs(data.qvel).max() < 20
        slack = 0.02 * span
        assert (data.qpos > ranges[:, 0] - slack).all() and (data.qpos < ranges[:, 1] + slack).all()
        reached[:, 0] = np.minimum(reached[:, 0], data.qpos)
        reached[:, 1] = np.maximum(reached[:, 1], data.qpos)
    assert np.allclose(reached, ranges, atol=0.05 * span.max())  # each joint went from end to end


def test_glb_has_a_node_per_part_and_an_animation(run, joints):
    scene = trimesh.load(run / "twin.glb")
    assert {"base", *(f"part_{k}" for k in joints)} <= set(scene.graph.nodes)
    data = (run / "twin.glb").read_bytes()
    length = struct.unpack("<I", data[12:16])[0]
    doc, block = json.loads(data[20 : 20 + length]), data[28 + length :]
    names = [n["name"] for n in doc["nodes"]]
    up = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # glTF is y-up
    for channel in doc["animations"][0]["channels"]:
        node = doc["nodes"][channel["target"]["node"]]
        joint = joints[int(node["name"][5:])]
        out = doc["accessors"][doc["animations"][0]["samplers"][channel["sampler"]]["output"]]
        view = doc["bufferViews"][out["bufferView"]]
        width = 4 if out["type"] == "VEC4" else 3
        keys = np.frombuffer(block, np.float32, out["count"] * width, view["byteOffset"]).reshape(-1, width)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = up @ np.array(joint["transform"])[:3, :3] @ up.T, up @ np.array(joint["transform"])[:3, 3]
        origin = up @ np.array(joint["origin"])
        assert np.allclose(node["translation"], origin, atol=1e-6) and np.allclose(
            node["extras"]["joint"]["axis"], up @ joint["axis"], atol=1e-6
        )
        half = keys[4]  # the middle of the film is the end state
        if width == 3:
            assert np.allclose(half, origin + T[:3, 3], atol=1e-6) and np.allclose(keys[0], origin, atol=1e-6)
        else:
            turn = trimesh.transformations.quaternion_matrix([half[3], *half[:3]])[:3, :3]
            assert np.allclose(turn, T[:3, :3], atol=1e-6) and np.allclose(keys[0], [0, 0, 0, 1], atol=1e-6)
    want = trimesh.load(run / "meshes" / "start" / "whole.ply", process=False).vertices @ up.T
    assert np.allclose(scene.bounds, [want.min(0), want.max(0)], atol=0.02) and len(names) == 2 + len(joints)


def test_usd_text_is_complete(run, joints):
    text = (run / "twin.usda").read_text()
    assert (
        text.startswith("#usda 1.0")
        and text.count("{") == text.count("}")
        and text.count('def Mesh "visual"') == 1 + len(joints)
    )
    assert all(f'def Physics{joint["type"].capitalize()}Joint "joint_{k}"' in text for k, joint in joints.items())


def test_usd_opens_in_usd_core_and_agrees_with_the_twin(run, joints):
    pytest.importorskip("pxr", reason="usd-core is not installed (pip install p2gs[validate])")
    from pxr import Gf, Usd, UsdGeom, UsdPhysics

    stage = Usd.Stage.Open(str(run / "twin.usda"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and math.isclose(UsdGeom.GetStageMetersPerUnit(stage), 1.0)
    for k, joint in joints.items():
        kind = UsdPhysics.RevoluteJoint if joint["type"] == "revolute" else UsdPhysics.PrismaticJoint
        got = kind(stage.GetPrimAtPath(f"/twin/joint_{k}"))
        limits = [got.GetLowerLimitAttr().Get(), got.GetUpperLimitAttr().Get()]
        assert np.allclose(
            np.radians(limits) if joint["type"] == "revolute" else limits, sorted([0, si(joint)]), atol=1e-6
        )
        # Gf.Rotation goes by acos
        axis = Gf.Quatd(got.GetLocalRot0Attr().Get()).GetNormalized().Transform(Gf.Vec3d(1, 0, 0))
        assert np.allclose(axis, joint["axis"], atol=1e-6) and np.allclose(
            got.GetLocalPos0Attr().Get(), joint["origin"], atol=1e-6
        )
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), [UsdGeom.Tokens.default_])
    box = cache.ComputeWorldBound(stage.GetPrimAtPath("/twin")).ComputeAlignedRange()
    want = trimesh.load(run / "meshes" / "start" / "whole.ply", process=False).bounds
    assert np.allclose([box.GetMin(), box.GetMax()], want, atol=0.02)


TURNS = {
    "z": np.eye(3),
    "y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "x": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
}


@pytest.mark.parametrize("up, origin, scale", [("y", "bottom", 0.5), ("x", "center", 2.0), ("z", "keep", 0.1)])
def test_every_format_stands_where_scale_up_and_origin_say(run, joints, tmp_path, up, origin, scale):
    """Joints and surfaces of URDF, MJCF, GLB and USD are those of twin.json under one and the same x -> scale R (x -
    origin)."""
    import mujoco
    import yourdfpy

    export_run(run, ["urdf", "mjcf", "glb"], tmp_path, scale=scale, up=up, origin=origin)
    points = np.concatenate(
        [trimesh.load(run / "meshes" / "start" / f"part_{k}.ply", process=False).vertices for k in (0, *joints)]
    )
    lo, hi = points.min(0), points.max(0)
    where = {"keep": np.zeros(3), "center": (lo + hi) / 2, "bottom": np.array([*(lo + hi)[:2] / 2, lo[2]])}[origin]
    R = TURNS[up]
    moved = scale * (points - where) @ R.T
    box = np.array([moved.min(0), moved.max(0)])
    near = 0.02 * scale

    robot = yourdfpy.URDF.load(str(tmp_path / "twin.urdf"))
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "twin.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    glb = trimesh.load(tmp_path / "twin.glb")
    assert np.allclose(robot.scene.bounds, box, atol=near) and np.allclose(glb.bounds, box, atol=near)
    down = -np.eye(3)["xyz".index(up)]
    assert np.allclose(model.opt.gravity / np.linalg.norm(model.opt.gravity), down)
    for k, joint in joints.items():
        at, axis = scale * R @ (np.array(joint["origin"]) - where), R @ np.array(joint["axis"])
        reach = math.radians(joint["motion"]) if joint["type"] == "revolute" else scale * joint["motion"]
        got = robot.joint_map[f"joint_{k}"]
        assert np.allclose(got.axis, axis, atol=1e-6) and np.allclose(got.origin[:3, 3], at, atol=1e-6)
        assert np.allclose([got.limit.lower, got.limit.upper], sorted([0, reach]), atol=1e-6)
        number = model.joint(f"joint_{k}").id
        assert np.allclose(data.xaxis[number], axis, atol=1e-6) and np.allclose(data.xanchor[number], at, atol=1e-6)
        assert np.allclose(model.jnt_range[number], sorted([0, reach]), atol=1e-6)
        assert np.allclose(glb.graph.get(f"part_{k}")[0][:3, 3], at, atol=1e-6)
    if up == "x":
        with pytest.raises(UserError, match="a USD stage stands on y or z"):
            export_run(run, ["usd"], tmp_path, up=up)
        return
    text = export_run(run, ["usd"], tmp_path, scale=scale, up=up, origin=origin)[0].read_text()
    assert f'upAxis = "{up.upper()}"' in text
    for k, joint in joints.items():
        block = text[text.index(f'Joint "joint_{k}"') :]
        got = [float(x) for x in block[block.index("localPos0 = (") + 13 :].split(")")[0].split(",")]
        assert np.allclose(got, scale * R @ (np.array(joint["origin"]) - where), atol=1e-6)


def test_scale_up_and_origin(toy, tmp_path):
    asset = load_asset(toy, scale=0.5, up="y", origin="bottom")
    points = np.concatenate([link.visual.vertices + link.origin for link in asset.links])
    lo, hi = points.min(0), points.max(0)
    assert abs(lo[1]) < 1e-6 and np.allclose((lo + hi)[[0, 2]], 0, atol=0.02) and (hi - lo).max() < 0.7
    drawer = asset.links[2].joint
    # -y comes to the viewer
    assert math.isclose(drawer.motion, 0.2, rel_tol=1e-6) and np.allclose(drawer.axis, [0, 0, 1], atol=1e-6)
    assert math.isclose(asset.links[1].joint.motion, math.radians(-70), rel_tol=1e-6)
    for bad, told in ((dict(up="w"), "--up is 'w'"), (dict(origin="left"), "--origin"), (dict(scale=0.0), "--scale")):
        with pytest.raises(UserError, match=told):
            load_asset(toy, **bad)
    with pytest.raises(UserError, match="did you mean 'urdf'"):
        export_run(toy, ["urfd"], tmp_path)
    files = export_run(toy, ["obj", "ply"], tmp_path)
    assert all((f / f"part_2.{s}").is_file() for f, s in zip(files, ("obj", "ply"), strict=True))
    assert set(EXPORTERS) == {"urdf", "mjcf", "glb", "usd", "splats", "spz", "ply", "obj"}


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_no_placement_mirrors(up):
    place = placement(np.zeros((1, 3)), 2.0, up, "keep")
    assert math.isclose(np.linalg.det(place.rotation), 1.0)
    assert np.allclose(place.points(np.array([0, 0, 1.0])), 2.0 * np.eye(3)["xyz".index(up)])


def open_box(n=20):
    g = np.linspace(0, 1, n)
    a, b = (x.reshape(-1) for x in np.meshgrid(g, g))
    o = np.zeros_like(a)
    sides = [np.c_[a, b, o], np.c_[a, b, o + 1], np.c_[o, a, b], np.c_[o + 1, a, b], np.c_[a, o + 1, b]]
    return np.concatenate(sides)


def test_an_open_box_falls_apart_into_panels_that_cover_it():
    points = open_box()
    pieces = decompose(points)
    assert 5 <= len(pieces) <= 20 and sum(p.volume for p in pieces) < 0.15  # one hull would have 1.0
    inside = np.zeros(len(points), bool)
    for p in pieces:
        n, d = p.planes()
        inside |= (points @ n.T <= d + 0.01).all(1)
        assert trimesh.Trimesh(p.vertices, p.faces, process=False).is_volume
    assert inside.mean() > 0.99
    middle = np.array([[0.5, 0.4, 0.5]])  # the hollow stays hollow
    assert not any((middle @ p.planes()[0].T <= p.planes()[1]).all() for p in pieces)


def test_a_flat_thing_gets_thickness():
    square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0.5, 0.5, 0]], float)
    assert math.isclose(hull(square, 0.02).volume, 0.02, rel_tol=1e-3)


def test_pieces_intersect_where_they_do():
    cube = hull(np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float), 0.01)
    assert math.isclose(cube.volume, 1.0, rel_tol=1e-6)
    for shift, want in (((0.9, 0.9, 0.9), True), ((1.1, 0, 0), False), ((0.999, 0, 0), False)):
        assert intersect(cube, Piece(cube.vertices + shift, cube.faces), 0.01) is want
    bar = hull(np.array([[x, y, z] for x in (-1, 2) for y in (0.4, 0.6) for z in (0.4, 0.6)], float), 0.01)
    assert intersect(cube, bar, 0.01)  # crossing, though neither has a corner in the other


def test_inertia_of_two_boxes_is_that_of_the_bar_they_make():
    def box(lo, hi):
        return hull(np.array([[x, y, z] for x in (lo, hi) for y in (0, 1) for z in (0, 1)], float), 0.01)

    got = inertia_of([box(0, 1), box(1, 3)], density=2.0)
    a, b, c = 3.0, 1.0, 1.0
    assert math.isclose(got.mass, 6.0, rel_tol=1e-6) and np.allclose(got.center, [1.5, 0.5, 0.5], atol=1e-6)
    assert np.allclose(got.matrix, np.diag([b * b + c * c, a * a + c * c, a * a + b * b]) * got.mass / 12, atol=1e-5)


def test_simplify_keeps_the_shape():
    ball = trimesh.creation.icosphere(subdivisions=5)
    mesh = Mesh(ball.vertices, ball.faces, np.full((len(ball.vertices), 3), 90, np.uint8))
    small = simplify(mesh, 2000)
    assert 1900 < len(small.faces) <= 2000 and (small.colours == 90).all()
    assert abs(np.linalg.norm(small.vertices, axis=1) - 1).max() < 0.005
    assert math.isclose(trimesh.Trimesh(small.vertices, small.faces).volume, ball.volume, rel_tol=0.01)
    assert simplify(mesh, len(mesh.faces)) is mesh


def test_simplify_keeps_the_two_sides_of_a_thin_wall_apart():
    """A lens, red above and white below, a hundredth as thick as wide: no pink vertex, both sides stay where they
    are."""
    lens = trimesh.creation.icosphere(subdivisions=5)
    lens.apply_transform(np.diag([1, 1, 0.01, 1]))
    colours = np.where(lens.vertices[:, 2:] > 0, [255, 0, 0], [255, 255, 255]).astype(np.uint8)
    small = simplify(Mesh(lens.vertices, lens.faces, colours), 1000)
    assert len(small.faces) <= 1000 and set(small.colours[:, 1].tolist()) == {0, 255}
    radius = np.linalg.norm(small.vertices / [1, 1, 0.01], axis=1)
    assert np.abs(radius - 1).max() < 0.03
    assert math.isclose(trimesh.Trimesh(small.vertices, small.faces).volume, lens.volume, rel_tol=0.03)


def test_normals_look_outward(run):
    ball = trimesh.creation.icosphere(subdivisions=2)
    assert (np.einsum("ij,ij->i", vertex_normals(ball.vertices, ball.faces), ball.vertices) > 0.99).all()
    assert glb_bytes(load_asset(run, up="y"))[:4] == b"glTF"
