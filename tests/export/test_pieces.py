"""What slides through something that hides its middle is joined along its axis; what is seen to be apart or is one
piece stays so."""

import numpy as np
import pytest
import torch
import trimesh
from toy import ring
from traced import boards, seen

from p2gs.ops.mesh import Mesh, connected, largest_components
from p2gs.surface.pieces import Piece, bridge, join_pieces
from p2gs.surface.tsdf import fuse

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
    return mesh, join_pieces(mesh, AXIS, views, poses, VOXEL)


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
    assert len(join_pieces(Mesh.empty(), AXIS, [], [], VOXEL).faces) == 0


def tube(lo, hi, wide=0.1, narrow=None):
    """A round bar along x, which narrows to its middle."""
    t = trimesh.creation.cylinder(1.0, 1.0, sections=24).subdivide_to_size(0.02, max_iter=20)
    x = lo + (t.vertices[:, 2] + 0.5) * (hi - lo)
    radius = np.interp(x, [lo, (lo + hi) / 2, hi], [wide, narrow or wide, wide])[:, None]
    return Mesh(
        np.column_stack([x, radius * t.vertices[:, :2]]), np.asarray(t.faces), np.zeros((len(t.vertices), 3), np.uint8)
    )


def pieces(*meshes):
    return [Piece(m, AXIS, 0.02) for m in meshes]


@pytest.mark.parametrize("flip", [1.0, -1.0])
def test_the_section_of_either_piece_is_drawn_to_the_other(flip):
    meshes = [tube(0.0, 0.6), tube(0.8, 1.5, wide=0.05)]
    left, right = pieces(*(Mesh(m.vertices * [flip, 1, 1], m.faces[:, ::-1], m.colours) for m in meshes))
    assert left.alike < 0.3 and flip * (left.hi if flip > 0 else left.lo) == pytest.approx(0.6, abs=0.03)
    ends = (left, right) if flip > 0 else (right, left)
    for drawn, radius, inner, outer in ((left, 0.1, 0.54, 0.8), (right, 0.05, 0.86, 0.6)):
        added = bridge(*ends, drawn)
        assert np.allclose(np.linalg.norm(added.vertices[:, 1:], axis=1), radius, atol=0.002)
        x = np.sort(flip * added.vertices[:, 0])[[0, -1]]
        assert np.allclose(x, sorted([inner, outer]), atol=0.03)
        assert len(connected(added)) == 1


def test_no_bridge_without_a_gap_or_over_more_than_a_piece_is_long():
    for a, b in (
        (tube(0.0, 0.6), tube(0.55, 1.2)),  # no gap
        (tube(0.0, 0.3), tube(0.9, 1.2)),
        (tube(0.0, 0.6, narrow=0.01), tube(0.8, 1.4, narrow=0.01)),  # no section
    ):
        left, right = pieces(a, b)
        assert bridge(left, right, left) is None and bridge(left, right, right) is None


def test_what_stands_out_of_its_sleeve_is_not_drawn_into_it():
    """A thick knob on a thin bar: it is the bar's section that the views do not contradict."""
    knob = ((0.3, -0.12, -0.13), (0.75, 0.12, 0.13))
    sleeve = ((-0.25, -0.12, -0.09), (0.25, 0.12, 0.09))
    apart, whole = joined([((-0.7, -0.08, -0.05), (0.3, 0.08, 0.05)), knob], body=[sleeve], slide=-0.15)
    added = trimesh.Trimesh(whole.vertices, whole.faces[len(apart.faces) :], process=False)
    assert len(connected(apart)) == 2 and len(connected(whole)) == 1
    assert np.abs(added.triangles_center[:, 2]).max() < 0.05 + VOXEL


def test_seen_apart_on_one_side_only():
    """Half of the section would stand where views see that nothing is: that half is left out."""
    sleeve = ((-0.25, -0.14, -0.14), (0.25, 0.02, 0.14))
    halves = [((-0.6, -0.08, -0.05), (-0.25, 0.08, 0.05)), ((0.05, -0.08, -0.05), (0.6, 0.08, 0.05))]
    apart, whole = joined(halves, body=[sleeve])
    added = trimesh.Trimesh(whole.vertices, whole.faces[len(apart.faces) :], process=False)
    assert len(added.faces) and np.quantile(added.triangles_center[:, 1], 0.99) < 0.02 + 3 * VOXEL
