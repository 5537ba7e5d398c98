"""Drawers whose rear no camera saw are completed as trays; what is no drawer, or was seen whole, is left as it was
seen."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree
from toy import ring
from traced import CRATE as BODY
from traced import boards, seen

from p2gs.ops.mesh import Mesh
from p2gs.surface.trays import DEPTH, clear_way, complete_tray, find_front, find_tray, not_the_trays
from p2gs.surface.tsdf import fuse
from p2gs.surface.unseen import eyes_of

VOXEL = 0.02
TRAVEL = 0.35
FRONT = ((0.5, -0.36, -0.2), (0.54, 0.36, 0.2))
TRAY = (
    FRONT,
    ((-0.3, -0.32, -0.18), (0.5, -0.3, 0.1)),
    ((-0.3, 0.3, -0.18), (0.5, 0.32, 0.1)),
    ((-0.3, -0.32, -0.18), (0.5, 0.32, -0.16)),
    ((-0.3, -0.32, -0.18), (-0.28, 0.32, 0.1)),
)


def moved(corners, by):
    return [tuple((x + by, y, z) for x, y, z in pair) for pair in corners]


def views_of(body, part, shifts, size=160):
    """Views of the body (0) and the part (1) in each state, and the part's poses."""
    views, poses = [], []
    for by in shifts:
        primitives = body + boards(*moved(part, by))
        for c in ring(10, size, elevations=(15.0, 40.0)):
            views.append(seen(primitives, len(body), c, 2 * VOXEL))
            pose = torch.eye(4, dtype=torch.float64)
            pose[0, 3] = by - shifts[0]
            poses.append(pose)
    return views, poses


def found(part, body=BODY, shifts=(0.0, TRAVEL)):
    """The part's mesh and the body's as seen, in the start state, the tray, and the views with the part's poses."""
    views, poses = views_of(body, part, shifts)
    still = [torch.eye(4, dtype=torch.float64)] * len(views)
    mesh, carcass = (fuse(views, p, k, VOXEL, 4 * VOXEL, 2 * VOXEL) for k, p in ((1, poses), (0, still)))
    slide = np.eye(4)
    slide[0, 3] = shifts[1] - shifts[0]
    return mesh, carcass, find_tray(mesh, carcass, slide, eyes_of(views, poses), VOXEL), (views, poses)


def completed(part, body=BODY, shifts=(0.0, TRAVEL)):
    """The part's mesh as seen and as completed, both in the start state."""
    mesh, _, tray, looks = found(part, body, shifts)
    return mesh, mesh if tray is None else complete_tray(mesh, tray, *looks, VOXEL, 4 * VOXEL)


@pytest.mark.parametrize("shifts", [(0.0, TRAVEL), (TRAVEL, 0.0)])
def test_a_drawer_gets_its_rear(shifts):
    seen, whole = completed(TRAY, shifts=shifts)
    truth = trimesh.util.concatenate([trimesh.creation.box(bounds=b) for b in moved(TRAY, shifts[0])])
    points = truth.sample(4000, seed=0)
    gap = [
        cKDTree(trimesh.Trimesh(m.vertices, m.faces, process=False).sample(8000, seed=0)).query(points)[0]
        for m in (seen, whole)
    ]
    assert gap[0].max() > 0.15 and gap[1].max() < 0.1
    back, end = 0.5 + shifts[0], -0.5 + shifts[0]
    assert whole.vertices[:, 0].min() == pytest.approx(back - DEPTH * (back - end), abs=2 * VOXEL)
    assert whole.vertices[:, 2].max() == pytest.approx(seen.vertices[:, 2].max())  # nothing over its mouth
    before, after = (trimesh.Trimesh(m.vertices, m.faces, process=False) for m in (seen, whole))
    assert not ((after.triangles_center[:, 2] > 0.12) & (after.triangles_center[:, 0] < 0.4 + shifts[0])).any()
    assert len(after.split(only_watertight=False)) <= len(before.split(only_watertight=False))  # sewn on


def test_what_is_beside_the_tray_is_not_its():
    """A board below the bottom, labelled the drawer's, goes; what stands out of the mouth stays."""
    bottom, top = ((0.2, -0.3, -0.38), (0.36, 0.3, -0.36)), ((0.2, -0.05, -0.16), (0.3, 0.05, 0.18))
    seen, whole = completed((*TRAY, bottom, top))
    before, after = ((m.vertices[:, 2] < -0.3, m.vertices[:, 2] > 0.15) for m in (seen, whole))
    assert before[0].any() and not after[0].any() and before[1].any() and after[1].any()


def test_one_that_was_seen_whole_is_left_alone():
    """A short tray comes out with its rear."""
    short = [FRONT] + [tuple((max(x, 0.25) if x < 0.5 else x, y, z) for x, y, z in pair) for pair in TRAY[1:4]]
    short.append(((0.25, -0.32, -0.18), (0.27, 0.32, 0.1)))
    seen, whole = completed(short)
    assert len(seen.faces) and whole is seen


@pytest.mark.parametrize(
    "part",
    [
        (FRONT,),  # a lid
        (FRONT, ((0.0, -0.3, -0.16), (0.5, 0.3, 0.16))),  # a block: nobody looks into it
        (((-0.3, -0.02, -0.02), (0.6, 0.02, 0.02)),),  # a rod
    ],
)
def test_what_is_no_drawer_is_left_alone(part):
    seen, whole = completed(part)
    assert len(seen.faces) and whole is seen


def test_without_a_body_behind_it_nothing_is_known():
    seen, whole = completed(TRAY, body=boards(((-0.5, -0.4, -0.4), (0.5, 0.4, -0.36))))
    assert whole is seen
    assert (
        find_front(
            Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]), np.zeros((3, 3), np.uint8)), np.array([1.0, 0, 0]), VOXEL
        )
        is None
    )


def sheet(at, size):
    t = trimesh.creation.box(size)
    return Mesh(t.vertices + at, t.faces, np.zeros((8, 3), np.uint8))


@pytest.mark.parametrize("shifts", [(0.0, TRAVEL), (TRAVEL, 0.0)])
def test_nothing_of_the_body_stands_in_the_trays_way(shifts):
    """A sheet across the drawer's way goes out of the body, in the drawer and before it; walls, and what is beside its
    way, stay."""
    _, body, tray, _ = found(TRAY, shifts=shifts)

    assert clear_way(body, tray, VOXEL) is body
    away, stays = [(0.2, 0, -0.05), (0.7, 0, -0.05)], [(1.1, 0, -0.05), (0.2, 0, 0.25), (-0.45, 0, 0)]
    for at in away + stays:
        cleared = clear_way(Mesh.join([body, sheet(at, (0.001, 0.1, 0.04))]), tray, VOXEL)
        assert len(cleared.faces) == len(body.faces) + (0 if at in away else 12), at


@pytest.mark.parametrize("shifts", [(0.0, TRAVEL), (TRAVEL, 0.0)])
def test_a_patch_of_another_part_on_the_trays_side_goes(shifts):
    """Where it is while the drawer is open tells: on its side, not before its front, beside it or over its mouth."""
    _, _, tray, _ = found(TRAY, shifts=shifts)
    # from the other part's start state, which moves to where it is while the drawer is open, to the drawer's own
    place = np.eye(4)
    place[:3, 3] = [-0.2, 0, 0.3]
    for at in ((0.3, -0.32, -0.05), (0.3, 0.31, 0.0), (0.3, -0.45, -0.05), (0.3, 0.0, 0.3), (0.75, 0.0, 0.0)):
        other = sheet(np.array([at[0] + shifts[0], *at[1:]]) - place[:3, 3], (0.1, 0.001, 0.04))
        kept = not_the_trays(other, tray, place, VOXEL)
        assert len(kept.faces) == (0 if abs(at[1]) in (0.32, 0.31) else 12), at


@pytest.mark.parametrize("shifts", [(0.0, TRAVEL), (TRAVEL, 0.0)])
def test_what_lies_on_the_trays_bottom_and_faces_its_mouth_is_not_the_bodys(shifts):
    """Where the open drawer covers it: what faces down (a board's underside), and what lies behind the open drawer, is
    the body's."""
    _, body, tray, _ = found(TRAY, shifts=shifts)
    bottom = -0.16

    def patch(x, z, up):
        faces = np.array([[0, 1, 2], [0, 2, 3]])[:, :: 1 if up else -1]
        corners = np.array([[x, -0.1, z], [x + 0.1, -0.1, z], [x + 0.1, 0.1, z], [x, 0.1, z]])
        return Mesh(corners, faces, np.zeros((4, 3), np.uint8))

    for x, z, up, goes in [
        (0.2, bottom, True, True),
        (0.2, bottom - 0.01, True, True),
        (0.2, bottom - 0.01, False, False),
        (0.2, bottom - 0.1, True, False),
        (-0.3, bottom - 0.01, True, False),
    ]:
        cleared = clear_way(Mesh.join([body, patch(x, z, up)]), tray, VOXEL)
        assert len(cleared.faces) == len(body.faces) + (0 if goes else 2), (x, z, up)
