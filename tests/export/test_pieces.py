"""What slides through something that hides its middle is joined along its axis; what is seen to be apart or is one piece stays so."""

import numpy as np
import pytest
import torch
import trimesh
from toy import ring
from traced import boards, seen

from p2gs.export.pieces import Piece, bridge, join_pieces
from p2gs.export.tsdf import Mesh, connected, fuse, largest_components

VOXEL = 0.015
SLIDE = 0.2
AXIS = np.array([1.0, 0.0, 0.0])
BAR = ((-0.6, -0.08, -0.05), (0.6, 0.08, 0.05))
SLEEVE = ((-0.25, -0.14, -0.14), (0.25, 0.14, 0.14))


def joined(part, body=(SLEEVE,), slide=SLIDE):
    """The part's mesh as seen and as joined, in the start state."""
    views, poses = [], []
    for by in (0.0, slide):
        primitives = boards(*body) + boards(*(tuple((x + by, y, z) for x, y, z in pair) for pair in part))
        for c in ring(10, 200, elevations=(15.0, 40.0, -30.0)):
            views.append(seen(primitives, len(body), c, 2 * VOXEL))
            poses.append(torch.eye(4, dtype=torch.float64))
            poses[-1][0, 3] = by
    mesh = largest_components(fuse(views, poses, 1, VOXEL, 4 * VOXEL, 2 * VOXEL))
    return mesh, join_pieces(mesh, AXIS, views, poses, VOXEL, 4 * VOXEL)


def test_a_bar_in_a_sleeve_is_one():
    apart, whole = joined([BAR])
    assert len(connected(apart)) == 2 and len(connected(whole)) == 1
    added = trimesh.Trimesh(whole.vertices, whole.faces[len(apart.faces) :], process=False)
    hidden = 0.5 - SLIDE  # of its length, in both states
    assert added.area == pytest.approx(hidden * 2 * (0.16 + 0.1), rel=0.2)
    off = np.abs(np.abs(added.triangles_center[:, 1:] / [0.08, 0.05]).max(1) - 1) * 0.05  # from the bar's sides
    assert np.quantile(off, 0.9) < VOXEL
    assert added.triangles_center[:, 0].min() > -0.35 and added.triangles_center[:, 0].max() < 0.15
    assert np.abs(whole.colours.astype(int) - 128).max() < 4  # as what was seen


def test_what_is_seen_to_be_apart_stays_apart():
    halves = [((-0.6, -0.08, -0.05), (-0.3, 0.08, 0.05)), ((0.2, -0.08, -0.05), (0.6, 0.08, 0.05))]
    low = [((-0.25, -0.14, -0.4), (0.25, 0.14, -0.3))]  # nothing hides the space between them
    apart, whole = joined(halves, low)
    assert len(connected(apart)) == 2 and len(connected(whole)) == 2 and len(whole.faces) == len(apart.faces)


def test_one_piece_and_no_piece_are_left_alone():
    apart, whole = joined([BAR], body=[((-0.25, -0.14, -0.4), (0.25, 0.14, -0.3))])
    assert len(connected(apart)) == 1 and whole is apart
    assert len(join_pieces(Mesh.empty(), AXIS, [], [], VOXEL, 4 * VOXEL).faces) == 0


def tube(lo, hi, wide=0.1, narrow=None):
    """A round bar along x, which narrows to its middle."""
    t = trimesh.creation.cylinder(1.0, 1.0, sections=24).subdivide_to_size(0.02, max_iter=20)
    x = lo + (t.vertices[:, 2] + 0.5) * (hi - lo)
    radius = np.interp(x, [lo, (lo + hi) / 2, hi], [wide, narrow or wide, wide])[:, None]
    return Mesh(np.column_stack([x, radius * t.vertices[:, :2]]), np.asarray(t.faces), np.zeros((len(t.vertices), 3), np.uint8))


def pieces(*meshes):
    return [Piece(m, AXIS, 0.02) for m in meshes]


def test_the_piece_whose_section_stays_the_same_is_drawn_on():
    left, right = pieces(tube(0.0, 0.6), tube(0.8, 1.4, narrow=0.05))
    assert left.alike < right.alike and left.hi == pytest.approx(0.6, abs=0.03)
    for flip in (1.0, -1.0):  # from left to right, and from right to left
        a, b = (Piece(Mesh(p.mesh.vertices * [flip, 1, 1], p.mesh.faces[:, ::-1], p.mesh.colours), AXIS, 0.02) for p in (left, right))
        added = bridge(*((a, b) if flip > 0 else (b, a)))
        assert np.allclose(np.linalg.norm(added.vertices[:, 1:], axis=1), 0.1, atol=0.002)
        x = flip * added.vertices[:, 0]
        assert x.max() == pytest.approx(0.8, abs=1e-6) and 0.5 < x.min() < 0.6
        assert len(connected(added)) == 1


def test_no_bridge_without_a_gap_or_over_more_than_a_piece_is_long():
    assert bridge(*pieces(tube(0.0, 0.6), tube(0.55, 1.2))) is None
    assert bridge(*pieces(tube(0.0, 0.3), tube(0.9, 1.2))) is None
    assert bridge(*pieces(tube(0.0, 0.6, narrow=0.02), tube(0.8, 1.4, narrow=0.02))) is None
