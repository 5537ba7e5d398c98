"""Closed parts: watertight, where the true surface is, thin walls with two sides, no lid over what was seen empty."""

import math

import numpy as np
import pytest
import torch
import trimesh
from toy import look_at, ring
from traced import CRATE, boards, seen

from p2gs.metrics.chamfer import sample_surface
from p2gs.ops.mesh import Mesh
from p2gs.surface.closed import (
    Cells,
    boundary,
    close,
    points_on,
    pulled_apart,
    simplified,
    without_scraps,
)
from p2gs.surface.faces import Faces
from p2gs.surface.sightings import TRUNCATION
from p2gs.surface.tsdf import fuse
from p2gs.surface.unseen import close_unseen_sides

EYE = torch.eye(4, dtype=torch.float64)
VOXEL = 0.03
BLOCK = boards(((-0.5, -0.4, -0.3), (0.5, 0.4, 0.3)))


def closed(primitives, cameras, voxel=VOXEL, complete=True):
    views = [seen(primitives, len(primitives), c, 2 * voxel) for c in cameras]
    poses = [EYE] * len(views)
    mesh = fuse(views, poses, 0, voxel, 4 * voxel, 2 * voxel)
    done = close_unseen_sides(mesh, views, poses, 0, voxel, 4 * voxel) if complete else mesh
    return close(mesh, done, views, poses, 0, voxel)


def solid_of(mesh: Mesh) -> trimesh.Trimesh:
    out = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert out.is_watertight and out.is_winding_consistent and out.volume > 0
    return out


def to_boxes(points, boxes):
    """Distance of points [N, 3] from the surface of the union of boxes, negative within one."""
    distances = []
    for lo, hi in np.array(boxes):
        q = np.abs(points - (lo + hi) / 2) - (hi - lo) / 2
        distances.append(np.linalg.norm(q.clip(min=0), axis=1) + q.max(1).clip(max=0))
    return np.min(distances, 0)


WALLS = [
    ((-0.5, -0.4, -0.3), (-0.46, 0.4, 0.3)),
    ((-0.5, -0.4, -0.3), (0.5, -0.36, 0.3)),
    ((-0.5, 0.36, -0.3), (0.5, 0.4, 0.3)),
    ((-0.5, -0.4, -0.3), (0.5, 0.4, -0.26)),
    ((-0.5, -0.4, 0.26), (0.5, 0.4, 0.3)),
]


def test_a_block_is_closed_by_its_guessed_underside():
    mesh = closed(BLOCK, ring(12, 160, elevations=(15.0, 40.0)))
    solid = solid_of(mesh)
    assert solid.volume == pytest.approx(0.48, rel=0.06)  # nobody saw its inside: it is filled
    down = solid.face_normals[:, 2] < -0.8
    guessed = solid.area_faces[mesh.guessed]
    assert 0.75 < guessed.sum() < 0.8 + 3.6 * VOXEL  # the underside, and at most a voxel's rim around it
    assert solid.area_faces[down & ~mesh.guessed].sum() < 0.08
    shown = sample_surface(mesh.only(~mesh.guessed), 3000)  # rims, where depth has an edge, reach out by a voxel or two
    assert np.quantile(np.abs(to_boxes(shown, [((-0.5, -0.4, -0.3), (0.5, 0.4, 0.3))])), 0.9) < 0.5 * VOXEL


def test_an_open_box_has_no_lid_and_walls_with_two_sides():
    cameras = ring(16, 160, elevations=(20.0, -20.0))
    mesh = closed(CRATE, cameras, voxel := 0.02)
    solid = solid_of(mesh)
    inside = np.random.default_rng(0).uniform((-0.4, -0.3, -0.2), (0.6, 0.3, 0.2), (300, 3))
    assert not solid.contains(inside).any()  # up to before its mouth
    middle = np.array([[-0.48, 0, 0], [0, -0.38, 0], [0, 0.38, 0], [0, 0, -0.28], [0, 0, 0.28]])
    assert solid.contains(middle).all()
    off = np.abs(to_boxes(sample_surface(mesh.only(~mesh.guessed), 3000), WALLS))
    assert np.quantile(off, 0.8) < 0.5 * voxel and off.max() < 3 * voxel


def test_a_plate_of_which_one_side_was_seen_gets_a_guessed_back():
    plate = boards(((-0.4, -0.02, -0.4), (0.4, 0.02, 0.4)))
    mesh = closed(plate, [look_at((x, -2.5, 0.3), (0, 0, 0)) for x in (-0.6, 0.0, 0.6)], complete=False)
    solid = solid_of(mesh)
    middle = solid.triangles_center
    front = middle[:, 1] < -0.01
    assert solid.area_faces[front & mesh.guessed].sum() < 0.1 < 0.5 < solid.area_faces[front & ~mesh.guessed].sum()
    assert solid.area_faces[~front & mesh.guessed].sum() > 0.5
    assert middle[:, 1].max() < -0.02 + 3 * VOXEL  # thin


def test_a_part_that_nobody_saw_is_empty():
    assert len(close(Mesh.empty(), Mesh.empty(), [], [], 0, VOXEL).faces) == 0


def test_points_on_a_mesh_leave_no_gaps():
    mesh = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 0.1, 0], [0, 0, 0.05]]), np.array([[0, 1, 2], [0, 2, 3]]))
    points = points_on(mesh, 0.1)
    u = np.random.default_rng(0).dirichlet((1, 1, 1), 200) @ mesh.vertices[[0, 1, 2]]
    gap = np.linalg.norm(u[:, None] - points, axis=2).min(1)
    assert gap.max() < 0.05 and len(points_on(Mesh.empty(), 0.1)) == 0


@pytest.mark.parametrize("max_faces", [2000, 4])
def test_simplified_meshes_stay_closed_and_near(max_faces):
    """Down to as many triangles as are asked for, or as the error allows."""
    ball = trimesh.creation.icosphere(subdivisions=5)
    out = simplified(Mesh(ball.vertices + 7, ball.faces), 0.02, max_faces)
    solid = solid_of(out)
    radius = np.linalg.norm(sample_surface(out, 2000) - 7, axis=1)
    assert len(out.faces) <= 2000 and np.abs(radius - 1).max() < 0.02
    assert max_faces == 4 or len(out.faces) > 1900
    assert solid.volume == pytest.approx(4 / 3 * math.pi, rel=0.02)
    with pytest.raises(ValueError, match="not closed"):
        simplified(Mesh(ball.vertices, ball.faces[ball.triangles_center[:, 2] > 0]), 0.01, max_faces)


def test_scraps_go_and_voids_stay():
    ball, void, scrap = (trimesh.creation.icosphere(2, radius) for radius in (1.0, 0.5, 0.05))
    void.invert()
    scrap.apply_translation([3, 0, 0])
    mesh = Mesh.of(trimesh.util.concatenate([ball, void, scrap]))
    volume = ball.volume + void.volume
    assert solid_of(without_scraps(mesh, 0.001)).volume == pytest.approx(volume)
    assert solid_of(without_scraps(mesh, 0.0001)).volume == pytest.approx(volume + scrap.volume)
    assert solid_of(without_scraps(mesh, 1000.0)).volume == pytest.approx(ball.volume)  # the largest, be it small


def test_solids_that_touch_along_an_edge_are_pulled_apart():
    """Closed also where a reader merges vertices of one place."""
    boxes = [trimesh.creation.box((4, 4, 2)).subdivide().subdivide() for _ in range(2)]
    boxes[1].apply_translation([4, 4, 0])
    mesh = Mesh.of(trimesh.util.concatenate(boxes))
    assert not trimesh.Trimesh(mesh.vertices, mesh.faces).is_watertight
    apart = pulled_apart(mesh, 0.01)
    merged = trimesh.Trimesh(apart.vertices.astype(np.float32), apart.faces)
    assert merged.is_watertight and merged.volume == pytest.approx(64, rel=0.001)
    assert np.abs(apart.vertices - mesh.vertices).max() <= 0.01 and (apart.vertices != mesh.vertices).any(1).sum() == 10


def test_a_surface_that_passes_middles_of_cells_has_no_steps():
    """A plane that rises by a twentieth of a cell from cell to cell."""
    x, _, z = np.mgrid[:60, :10, :20].astype(np.float32)
    field = ((z - 8.2 - x / 20) / TRUNCATION).clip(-1, 1)
    ones = np.ones(field.shape, np.float32)
    cells = Cells(np.zeros(3), 1.0, ones > 0, field, ones, ones)
    mesh = boundary(cells, field < 0, field > 1)
    assert np.quantile(Faces(mesh).normal[:, 2], 0.01) > 0.99
    assert np.abs(mesh.vertices[:, 2] - 8.2 - mesh.vertices[:, 0] / 20).max() < 0.02
