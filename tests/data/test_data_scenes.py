"""The readers on real benchmark scenes: poses, intrinsics and depth agree with the ground-truth meshes."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.ndimage import binary_dilation, minimum_filter

from p2gs.data.ground_truth import load_ground_truth
from p2gs.data.modules import DATASETS
from p2gs.data.report import StrictReport

SCENES = [
    ("paris", "paris/microwave", 148, False),
    ("paris", "paris/blade", 148, False),
    ("dta", "dta/fridge2", 128, True),
    ("artgs", "artgs/storage4", 148, True),
    ("artgs", "artgs/cabinet5", 148, True),
]
PARAMS = pytest.mark.parametrize("format, path, count, has_depth", SCENES, ids=[s[1] for s in SCENES])


def project(view, points):
    """Pixel column, row (floats) and z of world points [N, 3]."""
    cam = points @ view.camera.viewmat[:3, :3].double().numpy().T + view.camera.viewmat[:3, 3].double().numpy()
    uvw = cam @ view.camera.K.double().numpy().T
    return uvw[:, 0] / uvw[:, 2], uvw[:, 1] / uvw[:, 2], cam[:, 2]


def splatted_depth(view, points):
    """[H, W] smallest z of the points that fall on each pixel, inf where none does."""
    u, v, z = project(view, points)
    height, width = view.alpha.shape
    x, y = np.floor(u).astype(int), np.floor(v).astype(int)
    ok = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    depth = np.full((height, width), np.inf)
    np.minimum.at(depth, (y[ok], x[ok]), z[ok])
    return depth


def cast(view, mesh, rows, cols):
    """z of the mesh along the rays through pixel centres, nan where they miss."""
    pytest.importorskip("embreex", reason="casts rays at triangles")
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    K, M = view.camera.K.double().numpy(), view.camera.viewmat.double().numpy()
    directions = (
        np.stack([(cols + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1], np.ones(len(rows))], 1)
        @ M[:3, :3]
    )
    origins = np.tile(-M[:3, :3].T @ M[:3, 3], (len(rows), 1))
    where, which, _ = RayMeshIntersector(mesh).intersects_location(origins, directions, multiple_hits=False)
    z = np.full(len(rows), np.nan)
    z[which] = where @ M[2, :3] + M[2, 3]
    return z


@PARAMS
def test_gt_mesh_projects_into_masks_and_fills_them(scenes, format, path, count, has_depth):
    scene = DATASETS[format](root=str(scenes / path), max_views=2).raw_scene()
    truth = load_ground_truth(scenes / path, format)
    for state in (0, 1):
        mesh = trimesh.load(truth.meshes(state).whole)
        points = trimesh.sample.sample_surface(mesh, 150_000, seed=0)[0]
        for view in scene.select(state, "train"):
            mask = view.alpha.numpy() > 127
            u, v, _ = project(view, points)
            inside = binary_dilation(mask, iterations=1)[v.astype(int), u.astype(int)]
            assert inside.mean() > 0.999
            covered = np.isfinite(minimum_filter(splatted_depth(view, points), 3))
            assert covered[mask].mean() > 0.98


@PARAMS
def test_depth_agrees_with_gt_mesh(scenes, format, path, count, has_depth):
    scene = DATASETS[format](root=str(scenes / path), max_views=2).raw_scene()
    assert scene.has_depth == has_depth
    truth = load_ground_truth(scenes / path, format)
    for view in scene.select(split="train") if has_depth else ():
        measured = view.depth.numpy()
        rows, cols = np.nonzero(measured)
        keep = np.random.default_rng(0).choice(len(rows), 3000, replace=False)
        expected = cast(view, trimesh.load(truth.meshes(view.state).whole), rows[keep], cols[keep])
        error = np.abs(measured[rows[keep], cols[keep]] - expected)
        assert np.isfinite(error).mean() > 0.98
        error = error[np.isfinite(error)]
        assert np.median(error) < 1e-3, "depth is stored in millimetres"
        assert np.quantile(error, 0.97) < 0.02, "a few pixels on edges see past them"
        assert not view.depth[view.alpha < 128].any()


@PARAMS
def test_whole_scene_counts_and_internal_units(scenes, format, path, count, has_depth):
    data = DATASETS[format](root=str(scenes / path), max_views=20)
    frames = data.index(scenes / path, StrictReport())
    assert len(frames) == count and sum(f.split == "train" for f in frames) == 128
    raw, scene = data.raw_scene(), data.scene()
    assert len(raw.views) == len(scene.views) == count - 128 + 40
    assert raw.views[0].image.dtype == torch.uint8 and raw.views[0].image.shape == (400, 400, 3)
    # the box is centred, 2 in diagonal, and holds the object in both states without being much larger
    lo, hi = scene.box.double()
    torch.testing.assert_close(lo, -hi, atol=1e-5, rtol=0)
    assert abs(float((hi - lo).norm()) - 2) < 1e-4
    truth = load_ground_truth(scenes / path, format)
    bounds = np.stack([trimesh.load(truth.meshes(s).whole).bounds for s in (0, 1)])
    inner = scene.similarity.to_internal(torch.from_numpy(np.stack([bounds[:, 0].min(0), bounds[:, 1].max(0)])))
    assert (inner[0] > lo - 0.01).all() and (inner[1] < hi + 0.01).all()
    assert float((inner[1] - inner[0]).norm()) > 1.5
    # the same point of the world lands on the same pixel, at scaled depth
    points = torch.from_numpy(np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3)))
    torch.testing.assert_close(scene.similarity.to_input(scene.similarity.to_internal(points)), points)
    for i in (0, 19, 39):
        u0, v0, z0 = project(raw.views[i], points.numpy())
        u1, v1, z1 = project(scene.views[i], scene.similarity.to_internal(points).numpy())
        np.testing.assert_allclose(u0, u1, atol=2e-3)
        np.testing.assert_allclose(v0, v1, atol=2e-3)
        np.testing.assert_allclose(z0 * scene.similarity.scale, z1, atol=1e-5)
        if has_depth:
            torch.testing.assert_close(raw.views[i].depth * scene.similarity.scale, scene.views[i].depth)


@PARAMS
def test_gt_motion_maps_start_parts_onto_end_parts(scenes, format, path, count, has_depth):
    truth = load_ground_truth(scenes / path, format)
    assert len(truth.start.dynamic) == len(truth.end.dynamic) == len(truth.joints)
    for joint, start, end in zip(truth.joints, truth.start.dynamic, truth.end.dynamic, strict=True):
        a, b = trimesh.load(start, process=False).vertices, trimesh.load(end, process=False).vertices
        moved = a @ joint.transform[:3, :3].numpy().T + joint.transform[:3, 3].numpy()
        assert np.abs(moved - b).max() < 1e-4
        assert np.abs(a - b).max() > 0.1
        assert joint.limits == (min(0, joint.motion), max(0, joint.motion))


def test_internal_motion_leads_back_to_input_units(scenes):
    data = DATASETS["artgs"](root=str(scenes / "artgs/storage4"), max_views=8)
    similarity, joint = data.scene().similarity, load_ground_truth(scenes / "artgs/storage4").joints[0]
    T = joint.transform
    x = torch.rand(20, 3, dtype=torch.float64)
    a, b = similarity.to_internal(x), similarity.to_internal(x @ T[:3, :3].T + T[:3, 3])
    R = T[:3, :3]
    internal = torch.eye(4, dtype=torch.float64)
    internal[:3, :3], internal[:3, 3] = R, (b - a @ R.T)[0]
    torch.testing.assert_close(similarity.transform_to_input(internal), T)


def test_downscale_keeps_the_geometry(scenes):
    full = DATASETS["artgs"](root=str(scenes / "artgs/storage4"), max_views=2).raw_scene().views[0]
    half = DATASETS["artgs"](root=str(scenes / "artgs/storage4"), max_views=2, downscale=2).raw_scene().views[0]
    assert half.alpha.shape == half.depth.shape == (200, 200) and half.image.shape == (200, 200, 3)
    torch.testing.assert_close(half.camera.K[:2], full.camera.K[:2] / 2)
    fours = full.depth.reshape(200, 2, 200, 2).transpose(1, 2).reshape(200, 200, 4)
    known = (fours > 0).all(-1)  # where one of them is not, the nearest has its say
    expected = torch.where(known, 4 / (1 / fours.clamp_min(1e-9)).sum(-1), full.depth[1::2, 1::2])
    assert 0 < known.float().mean() < 1
    torch.testing.assert_close(half.depth, expected, rtol=1e-5, atol=1e-6)
    truth = full.alpha.float().reshape(200, 2, 200, 2).mean((1, 3))
    assert float((half.alpha.float() - truth).abs().max()) <= 0.51
