"""Surfaces: fusion of exact depth maps of a ball, and meshes of the hand-made cabinet from its own renders."""

import math

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree
from toy import look_at, ring, start_parts, toy_scene, toy_twin

from p2gs.export.run_folder import write_twin
from p2gs.gaussians.frame import object_to_input
from p2gs.gaussians.paint import part_coloured
from p2gs.gaussians.pose import pose
from p2gs.gaussians.views import scene_cameras
from p2gs.metrics.chamfer import sample_surface
from p2gs.ops.mesh import Mesh, largest_components
from p2gs.ops.rays import camera_rays
from p2gs.surface.depth_view import DepthView, add_normals
from p2gs.surface.mesh import mesh_cameras, part_meshes, read_mesh, write_mesh, write_meshes
from p2gs.surface.sightings import PartView, beside_others, fog_limit, look, start_motion, trust
from p2gs.surface.tsdf import ActiveGrid, fuse
from p2gs.types import GaussianTensors, UserError

EYE = torch.eye(4, dtype=torch.float64)
RADIUS, VOXEL = 0.5, 0.04


def ball_view(camera, center=(0.0, 0.0, 0.0), label=0):
    """Exact depth of a ball."""
    rays, c = (
        camera_rays(camera).double(),
        camera.viewmat[:3, :3].double() @ torch.tensor(center).double() + camera.viewmat[:3, 3].double(),
    )
    a, b, q = (rays * rays).sum(-1), (rays @ c), c @ c - RADIUS**2
    disc = b * b - a * q
    depth = torch.where(disc > 0, (b - disc.clamp_min(0).sqrt()) / a, torch.zeros_like(disc)).float()
    labels = torch.where(depth > 0, label, -1)
    world = (rays * depth[..., None] - camera.viewmat[:3, 3].double()) @ camera.viewmat[:3, :3].double()
    return add_normals(
        DepthView(camera, depth, labels, ((world.float() * 0.5 + 0.5).clamp(0, 1) * 255).byte()), 2 * VOXEL
    )


def cameras_all_round(size=200):
    return ring(6, size, elevations=(25.0, 50.0)) + ring(6, size, elevations=(-25.0, -60.0))


def test_a_ball_comes_back_as_a_closed_ball():
    views = [ball_view(c) for c in cameras_all_round()]
    mesh = fuse(views, [EYE] * len(views), 0, VOXEL, 4 * VOXEL, 2 * VOXEL)
    radius = np.linalg.norm(mesh.vertices, axis=1)
    # planes on a curved thing
    assert abs(radius - RADIUS).max() < 0.5 * VOXEL and abs(radius.mean() - RADIUS) < 0.15 * VOXEL
    ball = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    # > 0: faces look outward
    assert ball.is_watertight and math.isclose(ball.volume, 4 / 3 * math.pi * RADIUS**3, rel_tol=0.05)
    assert np.abs(mesh.colours / 255 - (mesh.vertices * 0.5 + 0.5)).max() < 0.06  # colours were painted by position


def test_views_of_a_moved_part_are_fused_in_its_own_frame():
    """Half the views see the ball from above, half see it, moved and turned, from below: together they close it."""
    T = EYE.clone()
    T[:3, :3] = torch.tensor([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]])
    T[:3, 3] = torch.tensor([0.3, -0.1, 0.2])
    up, down = ring(8, 200, elevations=(30.0, 60.0)), ring(8, 200, elevations=(-30.0, -60.0))
    views = [ball_view(c) for c in up] + [ball_view(c, (0.3, -0.1, 0.2)) for c in down]
    mesh = fuse(views, [EYE] * 8 + [T] * 8, 0, VOXEL, 4 * VOXEL, 2 * VOXEL)
    assert abs(np.linalg.norm(mesh.vertices, axis=1) - RADIUS).max() < 0.6 * VOXEL
    area = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).area
    assert 0.97 < area / (4 * math.pi * RADIUS**2) < 1.03
    half = fuse(views[:8], [EYE] * 8, 0, VOXEL, 4 * VOXEL, 2 * VOXEL)
    assert half.vertices[:, 2].min() > -0.45 and len(half.faces) < 0.9 * len(mesh.faces)  # what nobody saw is left open


def test_another_parts_pixels_do_not_become_surface():
    views = [ball_view(c, label=1) for c in ring(4)]
    assert len(fuse(views, [EYE] * 4, 0, VOXEL, 4 * VOXEL, 2 * VOXEL).faces) == 0
    assert len(fuse(views, [EYE] * 4, 1, VOXEL, 4 * VOXEL, 2 * VOXEL).faces) > 0


def test_space_that_other_views_see_through_is_carved():
    """One view has a false wall in front of the ball; the others look through it."""
    views = [ball_view(c) for c in cameras_all_round()]
    bad = views[0]
    bad.depth[80:120, 80:120] -= 0.4
    views[0] = add_normals(DepthView(bad.camera, bad.depth, bad.labels, bad.colour), 2 * VOXEL)
    mesh = fuse(views, [EYE] * len(views), 0, VOXEL, 4 * VOXEL, 2 * VOXEL)
    assert np.linalg.norm(mesh.vertices, axis=1).max() < RADIUS + VOXEL


def test_a_thin_plate_keeps_its_two_sides():
    """A plate of 2.5 voxels seen from both sides: two surfaces at the right distance."""
    thick, views = 2.5 * VOXEL, []
    for camera in (look_at((0.3, y, 0.2), (0, 0, 0)) for y in (-2.5, 2.5)):
        rays = camera_rays(camera).double() @ camera.viewmat[:3, :3].double()
        eye = camera.position.double()
        s = (math.copysign(thick / 2, float(eye[1])) - eye[1]) / rays[..., 1]
        hit = eye + rays * s[..., None]
        ok = (hit[..., [0, 2]].abs() < 0.4).all(-1)
        depth = torch.where(ok, s, torch.zeros_like(s)).float()
        views.append(
            add_normals(
                DepthView(camera, depth, torch.where(ok, 0, -1), torch.full((100, 100, 3), 255, dtype=torch.uint8)),
                2 * VOXEL,
            )
        )
    mesh = fuse(views, [EYE, EYE], 0, VOXEL, 4 * VOXEL, 2 * VOXEL)
    inner = mesh.vertices[(np.abs(mesh.vertices[:, [0, 2]]) < 0.3).all(1)]
    assert (
        abs(np.abs(inner[:, 1]) - thick / 2).max() < 0.25 * VOXEL
        and (inner[:, 1] > 0).any()
        and (inner[:, 1] < 0).any()
    )


def test_grid_holds_every_voxel_near_a_point():
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)).double()
    grid = ActiveGrid.around([points[:50], points[:0], points[50:]], 0.05)
    x = grid.centers().double()
    distance = torch.cdist(points, x).amin(1)
    assert (distance <= 0.05 * math.sqrt(3) / 2 + 1e-6).all()
    assert grid.index.min() >= 0 and (grid.index.amax(0) < torch.tensor(grid.shape)).all()


def test_small_components_go():
    sphere = trimesh.creation.icosphere(subdivisions=2)
    tetra = trimesh.creation.icosphere(subdivisions=0)
    a = Mesh(sphere.vertices, sphere.faces, np.zeros((len(sphere.vertices), 3), np.uint8))
    b = Mesh(tetra.vertices + 5, tetra.faces, np.ones((len(tetra.vertices), 3), np.uint8))
    kept = largest_components(Mesh.join([b, a]))
    assert len(kept.faces) == len(a.faces) and kept.vertices.max() < 2 and (kept.colours == 0).all()
    assert len(largest_components(Mesh.join([b, a]), 0.01).faces) == len(a.faces) + len(b.faces)


def test_mesh_ply_opens_elsewhere(tmp_path):
    sphere = trimesh.creation.icosphere(subdivisions=1)
    colours = np.arange(3 * len(sphere.vertices), dtype=np.uint8).reshape(-1, 3)
    path = write_mesh(tmp_path / "a.ply", Mesh(sphere.vertices, sphere.faces, colours))
    other, own = trimesh.load(path, process=False), read_mesh(path)
    assert np.allclose(other.vertices, sphere.vertices, atol=1e-6) and np.array_equal(other.faces, sphere.faces)
    assert np.array_equal(other.visual.vertex_colors[:, :3], colours)
    assert (
        np.allclose(own.vertices, sphere.vertices, atol=1e-6)
        and np.array_equal(own.faces, sphere.faces)
        and np.array_equal(own.colours, colours)
    )


def test_labels_are_the_front_parts():
    twin = object_to_input(toy_twin())
    camera = look_at((0.1, -2.5, 0.3), (0, 0, 0), 96)
    seen = look(twin.gaussians, twin.part_ids, 3, camera, 0.05)
    depth, label = seen.depth, seen.label
    assert set(label.unique().tolist()) == {-1, 0, 1, 2}
    assert label[48, 30] == 1 and label[48, 62] == 2 and label[2, 2] == -1 and depth[2, 2] == 0
    assert abs(float(depth[48, 30]) - (2.5 - 0.45)) < 0.05
    many = look(twin.gaussians, twin.part_ids * 9, 20, camera, 0.05).label  # more parts than a rasterizer has channels
    assert torch.equal(many, torch.where(label > 0, label * 9, label))
    painted = look(part_coloured(twin.gaussians, twin.part_ids), twin.part_ids, 3, camera, 0.05).colour
    assert painted[48, 30, 0] > painted[48, 30, 2] and painted[48, 62, 2] > painted[48, 62, 0]


def sheet(z, opacity, n=41):
    """Gaussians on a square of the plane at height z, flat and close enough to cover it."""
    g = torch.linspace(-0.5, 0.5, n)
    x, y = torch.meshgrid(g, g, indexing="ij")
    means = torch.stack([x, y, torch.full_like(x, z)], -1).reshape(-1, 3)
    count, step = len(means), float(g[1] - g[0])
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    scales = torch.tensor([step, step, 1e-3]).log().repeat(count, 1)
    return GaussianTensors(means, quats, scales, torch.full((count,), float(opacity)).logit(), torch.zeros(count, 1, 3))


def test_fog_is_no_surface_and_two_surfaces_have_no_mean():
    """A firm sheet is trusted; one behind a thin veil is found at its own depth or the veil's, never between; fog is
    not trusted."""
    camera = look_at((0.01, 0.0, 2.0), (0, 0, 0), 64)
    middle = (slice(28, 36), slice(28, 36))

    def seen(*layers):
        g = GaussianTensors.cat(list(layers))
        out = look(g, torch.zeros(len(g), dtype=torch.int64), 1, camera, near=0.02)
        return out.depth[middle], trust(out, 0.02)[middle]

    depth, sure = seen(sheet(0.0, 0.9))
    assert (depth - 2.0).abs().max() < 0.01 and sure.min() > 0.9
    depth, sure = seen(sheet(0.3, 0.02), sheet(0.0, 0.9))
    assert torch.minimum((depth - 2.0).abs(), (depth - 1.7).abs()).max() < 0.02 and sure.max() == 0
    depth, sure = seen(*(sheet(float(z), 0.03) for z in torch.linspace(0.3, 0, 12)))
    assert sure.max() == 0


def test_what_is_fog_is_told_by_what_is_usual():
    tight, loose = (PartView(*(torch.ones(4, 4),) * 4, torch.full((4, 4), s)) for s in (0.001, 0.1))
    assert fog_limit([tight, loose, tight], 1.0) == pytest.approx(0.02) and fog_limit([], 1.0) == pytest.approx(0.02)
    assert fog_limit([loose, loose, tight], 1.0) == pytest.approx(0.25)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    write_twin(toy_twin(), folder, toy_scene(n=8, size=110), media=False)
    write_meshes(folder, resolution=40)
    return folder


def test_cabinet_meshes_lie_on_its_panels(run):
    """In both states what was seen of a part's surface lies on that part's panels, and what closes it within two voxels
    of them; and the part's visible front is there."""
    panels, joints = start_parts()
    twin = object_to_input(toy_twin())
    for state, t in (("start", 0.0), ("end", 1.0)):
        for k in range(3):
            mesh = read_mesh(run / "meshes" / state / f"part_{k}.ply")
            truth = pose(twin, t).means[twin.part_ids == k].numpy()
            for shown, most in ((mesh.only(~mesh.guessed), 0.07), (mesh, 0.1)):  # voxels are 0.03, so are gaps
                distance = cKDTree(truth).query(sample_surface(shown, 5000))[0]
                assert np.quantile(distance, 0.95) < most, (state, k)
            assert len(mesh.faces) > 200
    drawer = read_mesh(run / "meshes" / "start" / "part_2.ply")
    front = drawer.vertices
    shown = sample_surface(drawer.only(~drawer.guessed), 5000)
    assert abs(np.quantile(shown[:, 1], 0.02) + 0.43) < 0.035  # Gaussians of a third of a voxel's depth and fuzzy rims
    moved = read_mesh(run / "meshes" / "end" / "part_2.ply").vertices
    assert np.allclose(moved - front, [0, -0.4, 0], atol=1e-5)
    whole = read_mesh(run / "meshes" / "end" / "whole.ply")
    assert len(whole.faces) == sum(len(read_mesh(run / "meshes" / "end" / f"part_{k}.ply").faces) for k in range(3))


def test_the_door_has_the_back_that_only_the_open_state_shows():
    twin = object_to_input(toy_twin())
    cameras = mesh_cameras(twin, scene_cameras(toy_scene(n=8, size=110)))
    shut = part_meshes(twin, [c for c in cameras if c[0] == 0], 40)[1]
    both = part_meshes(twin, cameras, 40)[1]

    def back(mesh):  # triangles of the door that were seen and face the cabinet's inside
        m = trimesh.Trimesh(mesh.vertices, mesh.faces[~mesh.guessed], process=False)
        return float(m.area_faces[m.face_normals[:, 1] > 0.7].sum())

    assert back(both) > 0.25 > 3 * back(shut)


def test_start_motion_is_the_joints_transform():
    twin = object_to_input(toy_twin())
    twin.canonical_time = 0.4
    assert torch.allclose(start_motion(twin, 1, 1.0), twin.parts[1].joint.transform, atol=1e-9)
    assert torch.allclose(start_motion(twin, 2, 0.0), EYE, atol=1e-12)


def test_without_cameras_an_orbit_is_used_and_nothing_to_see_is_told(tmp_path):
    twin = object_to_input(toy_twin())
    assert len(mesh_cameras(twin, [], count=12)) == 24
    twin.gaussians.opacity_logits[:] = -12
    write_twin(twin, tmp_path, toy_scene(n=2, size=16), media=False)
    with pytest.raises(UserError, match="nothing to mesh"):
        write_meshes(tmp_path, resolution=20)


def test_what_is_seen_beside_another_part_is_not_trusted():
    label = torch.tensor([[-1, -1, -1, -1, -1], [-1, 0, 0, 1, 1], [-1, 0, 0, 1, 1], [-1, 0, 0, 0, 0], [-1, 0, 0, 0, 0]])
    inside = (~beside_others(label)).nonzero().tolist()
    assert inside == [[4, 2], [4, 3], [4, 4]]
