"""``p2gs data render``: assets of a test's own, drawn and written, against the ray tracer of generated objects."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from p2gs.app import run as p2gs
from p2gs.data import modules  # noqa: F401  (registers the layouts)
from p2gs.data.base import DATASETS
from p2gs.data.check import check_dataset
from p2gs.data.generated import raytrace
from p2gs.data.generated.shapes import box
from p2gs.data.generated.textures import Texture
from p2gs.data.ground_truth import load_ground_truth
from p2gs.data.render.asset import euler, rotation
from p2gs.data.render.scene import PosedAsset, RenderOptions, Span, cameras_of, parse_spans, read_asset, render_scene
from p2gs.data.render.shapes import mesh_shapes
from p2gs.data.render.tracer import Tracer
from p2gs.types import UserError

pytest.importorskip("embreex")

BASE, DOOR, DRAWER = (0.4, 0.6, 0.8), (0.04, 0.5, 0.3), (0.3, 0.4, 0.2)  # full sizes
URDF = """<robot name="toy">
  <material name="red"><color rgba="0.8 0.1 0.1 1"/></material>
  <link name="body"><visual><geometry><box size="0.4 0.6 0.8"/></geometry></visual></link>
  <link name="door"><visual><origin xyz="0 0.25 0"/><geometry><box size="0.04 0.5 0.3"/></geometry>
    <material name="red"/></visual></link>
  <link name="knob"><visual><geometry><box size="0.06 0.04 0.04"/></geometry></visual></link>
  <link name="drawer"><visual><geometry><box size="0.3 0.4 0.2"/></geometry>
    <material name="own"><color rgba="0.1 0.2 0.9 1"/></material></visual></link>
  <joint name="hinge" type="revolute"><parent link="body"/><child link="door"/>
    <origin xyz="0.23 -0.25 0.2" rpy="0 0 0"/><axis xyz="0 0 2"/><limit lower="-2" upper="0"/></joint>
  <joint name="glue" type="fixed"><parent link="door"/><child link="knob"/><origin xyz="0.05 0.4 0"/></joint>
  <joint name="slide" type="prismatic"><parent link="body"/><child link="drawer"/>
    <origin xyz="0.1 0 -0.2" rpy="0 0 1.5707963267948966"/><axis xyz="0 -1 0"/><limit lower="0" upper="0.3"/></joint>
</robot>"""
MJCF = """<mujoco><compiler angle="radian"/>
  <default><geom type="box"/><default class="moving"><joint type="slide"/></default></default>
  <worldbody><body name="body"><geom size="0.2 0.3 0.4" rgba="0.6 0.6 0.6 1"/>
    <body name="door" pos="0.23 -0.25 0.2"><joint name="hinge" axis="0 0 2" range="-2 0"/>
      <geom pos="0 0.25 0" size="0.02 0.25 0.15" rgba="0.8 0.1 0.1 1"/>
      <body name="knob" pos="0.05 0.4 0"><geom size="0.03 0.02 0.02" rgba="0.6 0.6 0.6 1"/></body></body>
    <body name="drawer" pos="0.1 0 -0.2" euler="0 0 1.5707963267948966">
      <joint name="slide" class="moving" axis="0 -1 0" range="0 0.3"/>
      <geom size="0.15 0.2 0.1" rgba="0.1 0.2 0.9 1"/></body>
  </body></worldbody></mujoco>"""
SPANS = "hinge=0:-60,slide=0.05:0.25"
SMALL = RenderOptions(size=48, views=4, test_views=1, samples=4)


@pytest.fixture
def urdf(tmp_path):
    path = tmp_path / "toy.urdf"
    path.write_text(URDF)
    return path


@pytest.fixture
def mjcf(tmp_path):
    path = tmp_path / "toy.xml"
    path.write_text(MJCF)
    return path


def posed(path, spans=SPANS) -> PosedAsset:
    asset = read_asset(path)
    return PosedAsset(asset, parse_spans(spans, asset))


def by_hand(toy: PosedAsset, state: int):
    """The toy's boxes as the other ray tracer's primitives, in the world of the rendering, and their parts."""
    plain = Texture("plain", (0.5, 0.5, 0.5), (0.5, 0.5, 0.5))
    angle, way = np.radians((0, -60)[state]), (0.05, 0.25)[state]
    door = np.eye(4)
    door[:3, :3], door[:3, 3] = rotation(np.array([0, 0, 1.0]), angle), (0.23, -0.25, 0.2)
    knob = door @ translation(0.05, 0.4, 0)
    drawer = translation(0.1 + way, 0, -0.2) @ np.diag([0, 0, 1.0, 1.0])
    drawer[0, 1], drawer[1, 0] = -1, 1
    poses = [np.eye(4), door @ translation(0, 0.25, 0), knob, drawer]
    sizes = [BASE, DOOR, (0.06, 0.04, 0.04), DRAWER]
    fit = toy.poses[0]["body"]  # the base stands still: this is the scaling
    scale, centre = fit[0, 0], -fit[:3, 3] / fit[0, 0]
    boxes = [
        box(-np.array(s) / 2, np.array(s) / 2, plain).moved(T).scaled(scale, centre)
        for s, T in zip(sizes, poses, strict=True)
    ]
    return boxes, [0, 1, 1, 2]


def translation(x, y, z):
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


@pytest.mark.parametrize("state", [0, 1])
def test_pictures_equal_those_of_the_other_tracer(urdf, state):
    toy = posed(urdf)
    tracer = Tracer(toy.soup(state), samples=9)
    boxes, parts = by_hand(toy, state)
    for _, _, camera in cameras_of(RenderOptions(size=64, views=5, test_views=1), state):
        drawn = tracer.draw(camera)
        other = raytrace.render(boxes, parts, camera.viewmat.numpy(), camera.K.numpy(), 64, 64, samples=3)
        assert (drawn.part == other.parts).mean() > 0.998
        ours, theirs = drawn.alpha > 127, other.alpha > 127
        assert (ours & theirs).sum() / (ours | theirs).sum() > 0.995
        inner = (drawn.depth > 0) & (other.depth > 0) & (drawn.part == other.parts)
        assert np.quantile(np.abs(drawn.depth - other.depth)[inner], 0.9) < 2e-3


def test_ground_truth_is_where_the_joints_are(urdf):
    toy = posed(urdf)
    hinge, slide = toy.joints
    fit = toy.poses[0]["body"]
    assert (hinge.type, slide.type) == ("revolute", "prismatic")
    np.testing.assert_allclose(hinge.axis, [0, 0, 1])
    np.testing.assert_allclose(hinge.origin, fit[:3, :3] @ [0.23, -0.25, 0.2] + fit[:3, 3])
    assert (hinge.start, hinge.end) == (0, -60)
    np.testing.assert_allclose(slide.axis, [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose([slide.start, slide.end], np.array([0.05, 0.25]) * toy.scale)
    every = np.concatenate([toy.mesh(k, t)[0] for k in toy.parts for t in (0, 1)])
    assert np.linalg.norm(every, axis=1).max() == pytest.approx(1)


def test_the_joint_carries_the_start_mesh_onto_the_end_mesh(urdf):
    toy = posed(urdf)
    for k, joint in enumerate(toy.joints, 1):
        T = joint.transform(joint.motion)
        moved = toy.mesh(k, 0)[0] @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(moved, toy.mesh(k, 1)[0], atol=1e-9)
    np.testing.assert_array_equal(toy.mesh(0, 0)[0], toy.mesh(0, 1)[0])


def test_a_urdf_and_an_mjcf_of_one_object_give_the_same(urdf, mjcf):
    one, two = posed(urdf), posed(mjcf)
    for t in (0, 1):
        for k in one.parts:
            a, b = (p.mesh(k, t)[0] for p in (one, two))
            np.testing.assert_allclose(a[np.lexsort(a.T.round(6))], b[np.lexsort(b.T.round(6))], atol=1e-9)
    views = [render_scene(p, SMALL).views for p in (one, two)]
    for a, b in zip(*views, strict=True):
        assert torch.equal(a.image, b.image) and torch.equal(a.alpha, b.alpha)


@pytest.mark.parametrize("format", ["artgs", "paris", "dta"])
def test_the_command_writes_a_scene_that_reads_back(urdf, tmp_path, format, capsys):
    out = tmp_path / format
    words = ["data", "render", str(urdf), str(out), "--joints", SPANS, "--format", format]
    assert p2gs([*words, "--size", "64", "--views", "8", "--test_views", "2", "--samples", "4"]) == 0
    assert "written" in capsys.readouterr().out
    assert not [f for f in check_dataset(out) if f.level == "error"]
    scene = DATASETS[format](str(out)).raw_scene()
    assert len(scene.select(0, "train")) == 8 and json.loads((out / "render.json").read_text())["joints"] == SPANS
    found = load_ground_truth(out).joints
    toy = posed(urdf)
    for mine, theirs in zip(toy.joints, found, strict=True):
        np.testing.assert_allclose(theirs.transform.double().numpy(), mine.transform(mine.motion), atol=1e-6)
    for v, (_, _, camera) in zip(
        scene.select(1, "train"), cameras_of(RenderOptions(size=64, views=8), 1), strict=False
    ):
        torch.testing.assert_close(v.camera.viewmat, camera.viewmat, atol=1e-5, rtol=0)


def test_cameras_of_another_scene_and_the_same_pixels_again(urdf, tmp_path):
    words = ["data", "render", str(urdf), "--joints", SPANS, "--samples", "4"]
    sizes = ["--size", "40", "--views", "3", "--test_views", "1", "--seed", "7"]
    assert p2gs([*words[:3], str(tmp_path / "a"), *words[3:], *sizes]) == 0
    assert p2gs([*words[:3], str(tmp_path / "b"), *words[3:], "--cameras", str(tmp_path / "a")]) == 0
    pictures = [sorted((tmp_path / n).rglob("*.png")) for n in "ab"]
    assert len(pictures[0]) == 16
    for a, b in zip(*pictures, strict=True):
        one, two = (raw_pixels(p) for p in (a, b))
        assert np.abs(one.astype(int) - two.astype(int)).mean() < 0.5  # cameras were written with a few digits


@pytest.fixture
def uneven(tmp_path):
    """A scene whose cameras have a focal length and a centre of their own each."""
    toy = tmp_path / "toy.urdf"
    toy.write_text(URDF)
    root = tmp_path / "uneven"
    words = ["data", "render", str(toy), str(root), "--joints", SPANS, "--size", "40", "--views", "3"]
    assert p2gs([*words, "--test_views", "1", "--samples", "1"]) == 0
    for path in root.glob("transforms_*_*.json"):
        meta = json.loads(path.read_text())
        for k, frame in enumerate(meta["frames"]):
            frame |= {"fl_x": 60.0 + k, "fl_y": 61.0, "cx": 15.0 + 3 * k, "cy": 24.0}
        path.write_text(json.dumps(meta))
    return root


def test_cameras_with_intrinsics_of_their_own_are_written_so(urdf, uneven, tmp_path):
    words = ["data", "render", str(urdf), str(tmp_path / "out"), "--joints", SPANS, "--cameras", str(uneven)]
    assert p2gs([*words, "--samples", "1"]) == 0
    pairs = [DATASETS["artgs"](str(root)).raw_scene().views for root in (uneven, tmp_path / "out")]
    for a, b in zip(*pairs, strict=True):
        torch.testing.assert_close(a.camera.K, b.camera.K)


@pytest.mark.parametrize("format", ["paris", "dta"])
def test_a_layout_without_room_for_them_refuses(urdf, uneven, tmp_path, format, capsys):
    words = ["data", "render", str(urdf), str(tmp_path / "out"), "--joints", SPANS, "--cameras", str(uneven)]
    assert p2gs([*words, "--samples", "1", "--format", format]) == 2
    assert "holds one focal length and centre" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_colours_of_vertices_are_kept(tmp_path):
    import trimesh

    cube = trimesh.creation.box((1, 1, 1))
    cube.visual.vertex_colors = np.where(cube.vertices[:, :1] > 0, [[250, 10, 10, 255]], [[10, 10, 250, 255]])
    cube.export(tmp_path / "cube.ply")
    shape = mesh_shapes(tmp_path / "cube.ply", (1, 1, 1), np.eye(4), np.array([0, 1.0, 0]))[0]
    assert shape.image is not None and shape.uv is not None
    side, height = shape.image.shape[1], shape.image.shape[0]
    uv = shape.uv[shape.faces].mean(1)
    texels = shape.image[((1 - uv[:, 1]) * height).astype(int), (uv[:, 0] * side).astype(int)]
    middle = shape.vertices[shape.faces][..., 0].mean(1)
    assert (texels[middle > 0.49, 0] > 200).all() and (texels[middle < -0.49, 2] > 200).all()


def raw_pixels(path):
    import cv2

    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def test_without_joints_they_are_listed(urdf, capsys):
    assert p2gs(["data", "render", str(urdf)]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "hinge: revolute, -114.6 to 0 degrees",
        "slide: prismatic, 0 to 0.3",
    ]


@pytest.mark.parametrize(
    "spans, told",
    [
        ("hinges=0:10", "did you mean"),
        ("glue=0:10", "no movable joint 'glue'"),
        ("hinge=0:0", "expected two values"),
        ("hinge=0", "expected NAME=START:END"),
        ("hinge=0:nan", "expected two values"),
        ("hinge=0:-10,hinge=0:-20", "named twice"),
    ],
)
def test_a_mistake_in_the_joints_is_one_sentence(urdf, spans, told):
    with pytest.raises(UserError, match=told):
        posed(urdf, spans)


def test_values_beyond_the_limits_are_told(urdf, tmp_path, capsys):
    words = ["data", "render", str(urdf), str(tmp_path / "x"), "--joints", "hinge=0:40", "--size", "16", "--views", "1"]
    assert p2gs([*words, "--test_views", "0", "--samples", "1"]) == 0
    assert "hinge at 40 is outside its limits" in capsys.readouterr().out


@pytest.mark.parametrize(
    "old, new, told",
    [
        ('<box size="0.4 0.6 0.8"/>', '<mesh filename="gone.obj"/>', "gone.obj: the mesh file is missing"),
        ('<box size="0.4 0.6 0.8"/>', '<box size="0.4 0.6"/>', "expected 3 numbers"),
        ('xyz="0 0 2"', 'xyz="0 0 0"', "has no direction"),
        ('type="prismatic"', 'type="planar"', "the type 'planar' is not known"),
        ('<child link="door"/>', '<child link="window"/>', "which is not there"),
        ('<parent link="body"/><child link="door"/>', '<parent link="knob"/><child link="door"/>', "leads to a root"),
        ("</robot>", "", "is no XML"),
        ('<robot name="toy">', "<thing/>", "is no XML"),
    ],
)
def test_a_broken_urdf_is_one_sentence(urdf, old, new, told):
    assert old in URDF
    urdf.write_text(URDF.replace(old, new))
    with pytest.raises(UserError, match=told):
        asset = read_asset(urdf)
        PosedAsset(asset, [Span("slide", 0.0, 0.1)])


def test_a_scene_that_is_there_is_kept(urdf, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("x")
    words = ["data", "render", str(urdf), str(tmp_path / "out"), "--joints", SPANS, "--size", "16", "--views", "1"]
    assert p2gs([*words, "--samples", "1"]) == 2
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["mine.txt"]


def test_euler_angles_about_turned_and_fixed_axes():
    a, b, c = 0.3, -0.7, 1.1
    Rx, Ry, Rz = (rotation(np.eye(3)[i], v) for i, v in enumerate((a, b, c)))
    np.testing.assert_allclose(euler((a, b, c), "xyz"), Rx @ Ry @ Rz)
    np.testing.assert_allclose(euler((a, b, c), "XYZ"), Rz @ Ry @ Rx)


def test_a_texture_is_read_between_its_texels_and_repeats(tmp_path):
    """A square with a texture of two columns, seen from straight ahead: left and right differ, top is v = 1."""
    from PIL import Image

    Image.fromarray(np.array([[[255, 0, 0]] * 8, [[0, 0, 255]] * 8], np.uint8)).save(tmp_path / "two.png")
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd two.png\n")
    corners = "v -1 0 -1\nv 1 0 -1\nv 1 0 1\nv -1 0 1\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{corners}usemtl m\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n")
    body = URDF.replace('<box size="0.4 0.6 0.8"/>', '<mesh filename="a.obj" scale="1 1 0.5"/>')
    (tmp_path / "t.urdf").write_text(body)
    shape = read_asset(tmp_path / "t.urdf").links["body"][0]
    assert shape.image is not None and shape.vertices[:, 2].max() == 0.5
    toy = posed(tmp_path / "t.urdf")
    tracer, half = Tracer(toy.soup(0)), np.zeros(1)
    face = np.flatnonzero(toy.soup(0).texture >= 0)[:1]
    uv = toy.soup(0).uv[face[0]]
    top = int(np.argmax(uv[:, 1]))
    weights = np.full(3, 0.05)
    weights[top] = 0.9
    colour = tracer.colours(face, half + weights[1], half + weights[2])[0]
    assert colour[0] > 0.5 > colour[2]  # the first row of the picture is the top


def test_mitsuba_sees_the_same(urdf):
    """Colours by another renderer: the same places, nearly the same light (it hands light on, too)."""
    pytest.importorskip("mitsuba")
    views = {}
    for renderer in ("embree", "mitsuba"):
        options = RenderOptions(size=48, views=3, test_views=1, samples=16, renderer=renderer)
        views[renderer] = render_scene(posed(urdf), options).views
    for a, b in zip(*views.values(), strict=True):
        assert torch.equal(a.alpha, b.alpha) and torch.equal(a.depth, b.depth)
        inner = a.alpha == 255
        assert float((a.image[inner].float() - b.image[inner].float()).abs().mean()) < 16
