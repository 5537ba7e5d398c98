"""Generated objects and their ray tracer: against formulas, against a slow twin, and through the files."""

import json

import numpy as np
import pytest
import torch
import trimesh

from p2gs.data.generated.generate import synthesize
from p2gs.data.generated.raytrace import Shadow, render
from p2gs.data.generated.shapes import Primitive, ball, box, cylinder
from p2gs.data.generated.synthetic import KINDS, cabinet, intrinsics, look_at, make_object, render_view, train_cameras
from p2gs.data.generated.textures import PATTERNS, Texture
from p2gs.data.generated.write import write_scene
from p2gs.data.ground_truth import load_ground_truth
from p2gs.data.modules import DATASETS, SyntheticData
from p2gs.types import UserError

PLAIN = Texture("noise", (0.8, 0.5, 0.3), (0.4, 0.3, 0.2))
VIEW = look_at(np.array([2.5, -1.4, 1.3]))
KIND_NAMES = ["demo", *sorted(KINDS)]


def pixel_rays(viewmat, K, width, height):
    """Origin [3] and directions [H, W, 3] with camera z = 1."""
    x, y = np.meshgrid((np.arange(width) + 0.5 - K[0, 2]) / K[0, 0], (np.arange(height) + 0.5 - K[1, 2]) / K[1, 1])
    return -viewmat[:3, :3].T @ viewmat[:3, 3], np.stack([x, y, np.ones_like(x)], -1) @ viewmat[:3, :3]


def slow_depth(primitives, viewmat, K, size):
    """[H, W] depth and primitive index: one ray and one primitive at a time, float64; marching to where the ray is
    inside."""
    origin, directions = pixel_rays(viewmat, K, size, size)
    depth, index = np.full((size, size), np.inf), np.full((size, size), -1)
    for i in range(size):
        for j in range(size):
            for k, p in enumerate(primitives):
                R = p.pose[:3, :3]
                o, d = (origin - p.pose[:3, 3]) @ R, directions[i, j] @ R
                spans = []
                if p.kind in ("box", "cylinder"):
                    for a in range(3) if p.kind == "box" else (2,):
                        ends = sorted([(-p.size[a] - o[a]) / d[a], (p.size[a] - o[a]) / d[a]])
                        spans.append(ends)
                if p.kind in ("cylinder", "ball"):
                    n = 2 if p.kind == "cylinder" else 3
                    roots = np.roots([d[:n] @ d[:n], 2 * o[:n] @ d[:n], o[:n] @ o[:n] - p.size[0] ** 2])
                    if np.iscomplex(roots).any():
                        continue
                    spans.append(sorted(roots.real))
                near, far = max(s[0] for s in spans), min(s[1] for s in spans)
                if 0 < near < far and near < depth[i, j]:
                    depth[i, j], index[i, j] = near, k
    return depth, index


def turned(primitive: Primitive, seed: int) -> Primitive:
    from scipy.spatial.transform import Rotation

    T = np.eye(4)
    T[:3, :3] = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    return primitive.moved(T)


def test_tracer_equals_its_slow_twin():
    size = 40
    things = [
        box((-0.4, -0.3, -0.2), (0.3, 0.5, 0.1), PLAIN),
        turned(box((0.1, 0.1, 0.1), (0.6, 0.3, 0.5), PLAIN), 1),
        turned(cylinder((-0.5, 0.2, 0.2), (-0.1, 0.5, 0.6), 0.15, PLAIN), 2),
        ball((0.2, -0.5, 0.4), 0.25, PLAIN),
    ]
    K = intrinsics(size)
    r = render(things, [0, 1, 2, 3], VIEW, K, size, size)
    depth, index = slow_depth(things, VIEW, K, size)
    assert set(np.unique(index)) == {-1, 0, 1, 2, 3}
    np.testing.assert_allclose(r.depth, np.where(np.isfinite(depth), depth, 0), atol=1e-4)
    assert np.array_equal(r.parts, index)


def test_depth_of_a_plane_and_a_ball_by_formula():
    size, K = 120, intrinsics(120)
    origin, directions = pixel_rays(VIEW, K, size, size)
    slab = render([box((-9, -9, -1), (9, 9, 0), PLAIN)], [0], VIEW, K, size, size)
    expected = -origin[2] / directions[..., 2]
    on_top = (directions[..., 2] < 0) & (np.abs(origin + expected[..., None] * directions) < 8.9).all(-1)
    assert on_top.mean() > 0.5
    np.testing.assert_allclose(slab.depth[on_top], expected[on_top], rtol=1e-5)
    globe = render([ball((0, 0, 0), 0.5, PLAIN)], [0], VIEW, K, size, size)
    points = origin + globe.depth[..., None] * directions
    np.testing.assert_allclose(np.linalg.norm(points[globe.parts == 0], axis=1), 0.5, atol=1e-5)


def test_alpha_is_the_covered_share_of_the_pixel():
    """Against 8 x 8 rays a pixel; 2 x 2 rays can be off by their own step."""
    size, K = 60, intrinsics(60)
    things = [turned(box((-0.5, -0.4, -0.3), (0.5, 0.4, 0.3), PLAIN), 5)]
    coarse, fine = (render(things, [0], VIEW, K, size, size, samples=n) for n in (2, 8))
    a, b = coarse.alpha / 255, fine.alpha / 255
    assert set(np.unique(coarse.alpha)) <= {0, 64, 128, 191, 255}
    assert np.abs(a - b).max() <= 0.5 and abs(a.sum() / b.sum() - 1) < 2e-3
    inside = (a == 1) & (b == 1)
    assert np.abs(coarse.image[inside].astype(int) - fine.image[inside]).mean() < 6


def test_parts_and_masks_agree_with_the_meshes():
    """Part ids and depth against triangles, which know nothing of the analytic intersections."""
    obj, size = make_object("fridge", 4), 80
    K = intrinsics(size)
    primitives, parts = obj.posed(1.0)
    r = render(primitives, parts, VIEW, K, size, size)
    meshes = [trimesh.Trimesh(*obj.mesh(k, 1.0), process=False) for k in range(len(obj.parts))]
    whole = trimesh.util.concatenate(meshes)
    pytest.importorskip("embreex", reason="casts rays at triangles")
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    origin, directions = pixel_rays(VIEW, K, size, size)
    flat = directions.reshape(-1, 3)
    where, ray, face = RayMeshIntersector(whole).intersects_location(
        np.tile(origin, (len(flat), 1)), flat, multiple_hits=False
    )
    depth, part = np.zeros(size * size), np.full(size * size, -1)
    depth[ray] = where @ VIEW[2, :3] + VIEW[2, 3]
    part[ray] = np.searchsorted(np.cumsum([len(m.faces) for m in meshes]), face, side="right")
    assert {0, 1, 2} <= set(np.unique(part))
    assert (r.parts.ravel() == part).mean() > 0.995
    same = r.parts.ravel() == part
    error = np.abs(r.depth.ravel() - depth)[same]
    assert np.quantile(error, 0.995) < 1e-4, "all but the handles, whose triangles only approach the cylinders"
    assert error.max() < 0.1


def test_light_is_blocked_and_textures_are_bounded():
    floor, roof = box((-1, -1, -0.1), (1, 1, 0), PLAIN), box((-0.4, -0.4, 0.5), (0.4, 0.4, 0.55), PLAIN)
    # the light comes from +x, -y
    points = np.array([[-0.35, 0.25, 0.0], [0.9, 0.9, 0.0], [-0.9, -0.9, 0.0]], np.float32)
    assert Shadow([floor, roof]).lit(points).tolist() == [0, 1, 1]
    assert Shadow([floor]).lit(points).tolist() == [1, 1, 1]
    p = np.random.default_rng(0).uniform(-1, 1, (4000, 3)).astype(np.float32)
    for pattern in PATTERNS:
        colours = Texture(pattern, (0.9, 0.2, 0.1), (0.1, 0.3, 0.8), 0.2, 7).at(p)
        assert colours.dtype == np.float32 and colours.min() >= 0.1 - 1e-6 and colours.max() <= 0.9 + 1e-6
        assert colours.std(axis=0).min() > 0.01


@pytest.mark.parametrize("kind", KIND_NAMES)
def test_every_kind_is_sound(kind):
    """In the unit ball, one to six moving parts, visible motion, hardly any part inside another."""
    for seed in range(8):
        obj = make_object(kind, seed)
        assert obj.parts[0].joint is None and 1 <= len(obj.joints) == len(obj.parts) - 1 <= 6
        corners = [np.concatenate([q.corners for q in obj.posed(t)[0]]) for t in (0.0, 1.0)]
        assert 0.9 < max(np.linalg.norm(c, axis=1).max() for c in corners) < 1.0
        for t in (0.0, 1.0):
            assert obj.overlap(t, samples=60) < 0.01, (kind, seed, t)
        for joint in obj.joints:
            assert abs(np.linalg.norm(joint.axis) - 1) < 1e-12
            assert abs(joint.motion) > (15 if joint.type == "revolute" else 0.05), (kind, seed, joint)


def test_kinds_cover_both_joint_types_signs_and_part_open_starts():
    joints = [j for kind in sorted(KINDS) for seed in range(6) for j in make_object(kind, seed).joints]
    for kind in ("revolute", "prismatic"):
        mine = [j for j in joints if j.type == kind]
        assert any(j.motion < 0 for j in mine) and any(j.motion > 0 for j in mine) and any(j.start != 0 for j in mine)
    assert {len(make_object("cabinet", s).joints) for s in range(40)} >= {2, 3, 4, 5}
    assert len({make_object(None, s).name for s in range(30)}) > 6


def test_opening_shows_what_was_hidden():
    """The demo's interior: much of what the end state shows behind the door is part of the base and was covered
    before."""
    obj = cabinet()
    assert [j.type for j in obj.joints] == ["revolute", "prismatic"]
    viewmat, K = look_at(np.array([2.8, -0.9, 1.2])), intrinsics(100)
    shut, open_ = (render(*obj.posed(t), viewmat, K, 100, 100) for t in (0.0, 1.0))
    revealed = (shut.parts == 1) & (open_.parts == 0)
    assert revealed.sum() > 300
    assert np.median(open_.depth[revealed] - shut.depth[revealed]) > 0.2, "a hollow inside, not a painted board"


@pytest.mark.parametrize("kind", ["demo", "scissors", "table"])
def test_gt_transform_maps_start_mesh_onto_end_mesh(tmp_path, kind):
    obj = make_object(kind, 3)
    root = write_scene(obj, tmp_path / "s", size=16, train_views=1, test_views=0)
    truth = load_ground_truth(root)
    assert [j.type for j in truth.joints] == [j.type for j in obj.joints]
    for joint, mine, start, end in zip(truth.joints, obj.joints, truth.start.dynamic, truth.end.dynamic, strict=True):
        a, b = (trimesh.load(p, process=False).vertices for p in (start, end))
        moved = a @ joint.transform[:3, :3].numpy().T + joint.transform[:3, 3].numpy()
        assert np.abs(moved - b).max() < 1e-5
        assert joint.motion == pytest.approx(mine.motion)
    parts = [trimesh.load(p) for p in (truth.end.static, *truth.end.dynamic)]
    whole = trimesh.load(truth.end.whole)
    assert len(whole.faces) == sum(len(p.faces) for p in parts)
    assert sum(p.area for p in parts) == pytest.approx(whole.area, rel=1e-5)


def test_same_seed_same_pixels(toy):
    a, b = (render_view(toy, 1, "train", "x", train_cameras(4, 9)[2], 32) for _ in range(2))
    assert torch.equal(a.image, b.image) and torch.equal(a.depth, b.depth)
    assert not np.allclose(train_cameras(4, 9)[0], train_cameras(4, 8)[0])
    first, again, other = make_object("cabinet", 2), make_object("cabinet", 2), make_object("cabinet", 3)
    assert np.array_equal(first.mesh(0, 0)[0], again.mesh(0, 0)[0])
    assert first.mesh(0, 0)[0].shape != other.mesh(0, 0)[0].shape or not np.allclose(
        first.mesh(0, 0)[0], other.mesh(0, 0)[0]
    )


def test_data_module_writes_once_and_memory_is_the_same(tmp_path):
    options = {"kind": "chest", "object_seed": 2, "size": 32, "train_views": 5, "test_views": 1}
    root = tmp_path / "sub" / "chest"
    disk = SyntheticData(root=str(root), **options).scene()
    stamp = (root / "synthetic.json").stat().st_mtime_ns
    again = DATASETS["synthetic"](root=str(root), **options).scene()
    assert (root / "synthetic.json").stat().st_mtime_ns == stamp and len(list(root.parent.iterdir())) == 1
    memory = SyntheticData(root=None, **options).scene()
    assert len(disk.views) == len(again.views) == len(memory.views) == 12
    for a, b in zip(disk.views, memory.views, strict=True):
        assert (
            torch.equal(a.image, b.image)
            and torch.equal(a.alpha, b.alpha)
            and (a.state, a.split, a.name) == (b.state, b.split, b.name)
        )
        torch.testing.assert_close(a.camera.viewmat, b.camera.viewmat, atol=1e-5, rtol=0)
        torch.testing.assert_close(a.depth, b.depth, atol=1e-3, rtol=0)
    assert load_ground_truth(root, "synthetic") is not None
    few = SyntheticData(root=None, max_views=3, depth="never", downscale=2, **options).raw_scene()
    assert len(few.select(split="train")) == 6 and not few.has_depth and few.views[0].alpha.shape == (16, 16)
    with pytest.raises(UserError, match="holds another generated scene"):
        SyntheticData(root=str(root), **{**options, "size": 40}).scene()


def test_synthesize_refuses_and_leaves_nothing_behind(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="unknown kind of object 'cabinett' .did you mean 'cabinet'"):
        synthesize(tmp_path / "a", kind="cabinett")
    with pytest.raises(UserError, match="unknown data format 'dtaa' .did you mean 'dta'"):
        synthesize(tmp_path / "a", format="dtaa", size=16)
    with pytest.raises(UserError, match="at least 16 pixels"):
        synthesize(tmp_path / "a", size=8)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("x")
    with pytest.raises(UserError, match="is not an empty folder"):
        synthesize(tmp_path / "full", size=16)

    def interrupted(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr("p2gs.data.generated.write.write_ground_truth", interrupted)
    with pytest.raises(KeyboardInterrupt):
        synthesize(tmp_path / "b", size=16, train_views=1, test_views=0)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["full"]
    monkeypatch.undo()
    root = synthesize(tmp_path / "c", seed=6, kind="valve", size=16, train_views=2, test_views=1, format="paris")
    assert json.loads((root / "synthetic.json").read_text())["kind"] == "valve"
    assert len(DATASETS["paris"](root=str(root)).raw_scene().views) == 6
