"""Undersides that no camera saw are closed; what cameras see into or around is left as it was seen."""

import math

import numpy as np
import pytest
import torch
import trimesh
from toy import ring
from traced import CRATE, boards, seen

from p2gs.ops.mesh import Mesh
from p2gs.surface.plinth import plinth_height
from p2gs.surface.tsdf import fuse
from p2gs.surface.unseen import close_unseen_sides, eyes_of, facing, seen_empty

EYE = torch.eye(4, dtype=torch.float64)
VOXEL = 0.03

BLOCK = boards(((-0.5, -0.4, -0.3), (0.5, 0.4, 0.3)))
# a table: space between its legs is seen, and its legs are no rim
TABLE = boards(
    ((-0.5, -0.4, 0.1), (0.5, 0.4, 0.15)),
    *(((x, y, -0.3), (x + 0.1, y + 0.1, 0.1)) for x in (-0.5, 0.4) for y in (-0.4, 0.3)),
)


def look(primitives, cameras, lids=0):
    """Views of boards, the last ``lids`` of which are another part's."""
    return [seen(primitives, len(primitives) - lids, c, 2 * VOXEL) for c in cameras]


def closed(primitives, elevations=(15.0, 40.0), lids=0, voxel=VOXEL):
    """A mesh as it was seen, and with its unseen sides closed."""
    views = look(primitives, ring(12, 160, elevations=elevations), lids)
    poses = [EYE] * len(views)
    mesh = fuse(views, poses, 0, voxel, 4 * voxel, 2 * voxel)
    return mesh, close_unseen_sides(mesh, views, poses, 0, voxel, 4 * voxel)


def test_an_underside_that_no_camera_saw_is_closed():
    seen, whole = (trimesh.Trimesh(m.vertices, m.faces, process=False) for m in closed(BLOCK))
    down = [float(m.area_faces[m.face_normals[:, 2] < -0.5].sum()) for m in (seen, whole)]
    assert down[1] - down[0] == pytest.approx(0.8, rel=0.1) and whole.bounds[0, 2] == seen.bounds[0, 2]
    assert whole.volume == pytest.approx(0.48, rel=0.06)  # faces look outward
    assert len(whole.split(only_watertight=False)) == len(seen.split(only_watertight=False))  # sewn on


def test_what_closes_a_side_has_the_colours_around_it():
    assert np.abs(closed(BLOCK)[1].colours.astype(int) - 128).max() < 3


def test_what_is_seen_is_left_alone():
    for primitives, elevations in ((BLOCK, (15.0, 40.0, -30.0)), (CRATE, (15.0, 40.0)), (TABLE, (15.0, 40.0))):
        mesh, same = closed(primitives, elevations)
        assert len(mesh.faces) and same is mesh
    assert len(close_unseen_sides(Mesh.empty(), [], [], 0, VOXEL, 4 * VOXEL).faces) == 0


def test_a_mouth_that_a_door_covers_is_not_closed():
    """Cameras faced it: it is a door that they saw there, though nothing tells that the space behind is empty."""
    door = boards(((0.5, -0.4, -0.3), (0.54, 0.4, 0.3)))
    mesh, whole = closed(CRATE + door, lids=1)
    assert len(mesh.faces) < len(whole.faces)  # its underside
    front = [
        t.triangles_center[:, 0] > 0.4
        for t in (trimesh.Trimesh(m.vertices, m.faces, process=False) for m in (mesh, whole))
    ]
    assert front[1].sum() < 1.5 * front[0].sum()


def test_share_of_views_that_face_a_side():
    views = look(BLOCK, ring(12, 160, elevations=(15.0, 40.0)))
    side = torch.tensor([[0.5, -0.4, -0.3], [0.5, 0.4, 0.3]]).double()
    T = EYE.clone()
    T[0, 3] = 5.0  # the block is far to the right of where the cameras look
    share = [facing(side, torch.tensor([1.0, 0.0, 0.0]), eyes_of(views, [pose] * len(views))) for pose in (EYE, T)]
    below = facing(side, torch.tensor([0.0, 0.0, -1.0]), eyes_of(views, [EYE] * len(views)))
    assert 0.2 < share[0] < 0.5 and share[1] == 0.0 and below == 0.0


def test_seen_empty_tells_what_is_before_and_behind():
    (view,) = look(BLOCK, ring(1, 160, elevations=(0.0,)))
    toward = view.camera.position.double()[None] / float(view.camera.position.norm())
    points = torch.cat([1.2 * toward, 0.0 * toward, -1.2 * toward, torch.tensor([[0, 0, 9.0]])])
    # before the block; inside it; behind it; outside the picture
    assert seen_empty(points, [view], [EYE], 0.1).tolist() == [True, False, False, False]
    T = EYE.clone()
    T[2, 3] = 5.0 * math.sqrt(2)
    assert seen_empty(points, [view], [T], 0.1).tolist() == [False] * 4  # carried out of the picture


# a cupboard, open to +x, on walls and a kick board that stands back
PLINTH = 0.12
CUPBOARD = boards(
    ((-0.4, -0.4, PLINTH - 0.5), (0.4, 0.4, PLINTH - 0.4)),
    ((-0.4, -0.4, 0.46), (0.4, 0.4, 0.5)),
    *(((-0.4, y, PLINTH - 0.5), (0.4, y + 0.04, 0.5)) for y in (-0.4, 0.36)),
    ((-0.4, -0.4, -0.5), (-0.36, 0.4, 0.5)),
    *(((-0.4, y, -0.5), (0.28, y + 0.04, PLINTH - 0.5)) for y in (-0.4, 0.36)),
    ((0.24, -0.4, -0.5), (0.28, 0.4, PLINTH - 0.5)),
)


def test_what_stands_on_a_plinth_is_closed_on_top_of_it():
    seen, whole = (
        trimesh.Trimesh(m.vertices, m.faces, process=False)
        for m in closed(CUPBOARD, elevations=(0.0, 15.0, 40.0), voxel=0.012)
    )
    added = trimesh.Trimesh(whole.vertices, whole.faces[len(seen.faces) :], process=False)
    assert added.area == pytest.approx(0.8 * 0.8, rel=0.15) and (added.face_normals[:, 2] < -0.9).mean() > 0.8
    assert np.median(added.triangles_center[:, 2]) == pytest.approx(PLINTH - 0.5, abs=0.02)


@pytest.mark.parametrize(
    "height, back, found", [(0.12, 0.12, True), (0.05, 0.12, False), (0.12, 0.03, False), (0.4, 0.12, False)]
)
def test_toes_fit_under_a_front_that_stands_on_a_plinth(height, back, found):
    block = boards(((-0.4, -0.4, height - 0.5), (0.4, 0.4, 0.5)), ((-0.4, -0.4, -0.5), (0.4 - back, 0.4, height - 0.5)))
    mesh = fuse(look(block, ring(12, 160, elevations=(0.0, 15.0))), [EYE] * 12, 0, 0.01, 0.04, 0.02)
    high = plinth_height(mesh, 2, -1.0, -0.5, 1.0, 0.01)
    assert high == pytest.approx(height, abs=0.02) if found else high == 0.0
    assert plinth_height(mesh, 2, 1.0, 0.5, 1.0, 0.01) == 0.0


def test_the_level_in_which_a_plinth_ends_may_lie_half_over_it(monkeypatch):
    out = np.full((60, 4), 0.4)  # levels of 0.01, how far out they reach towards four sides
    out[12:, 1] = 0.5
    out[12, 1] = 0.44
    monkeypatch.setattr("p2gs.surface.plinth.edges", lambda mesh, axis, outward, at, levels, voxel: out[:levels])
    assert plinth_height(Mesh.empty(), 2, -1.0, -0.5, 1.0, 0.01) == pytest.approx(0.12)
    out[12, 1] = 0.5
    assert plinth_height(Mesh.empty(), 2, -1.0, -0.5, 1.0, 0.01) == pytest.approx(0.12)
