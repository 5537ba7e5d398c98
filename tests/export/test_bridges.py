"""A table keeps its leg, joined to its top; a sheet that hangs in an opening goes with the crumbs."""

import numpy as np
import pytest
import torch
from toy import ring
from traced import CRATE, boards, seen

from p2gs.ops.mesh import Mesh, components, connected, largest_components
from p2gs.surface.bridges import before_nothing, bridged, without_crumbs
from p2gs.surface.tsdf import fuse

VOXEL = 0.015
STILL = torch.eye(4, dtype=torch.float64)
TOP = ((-0.6, -0.4, 0.3), (0.6, 0.4, 0.36))
LEG = ((0.46, 0.29, -0.12), (0.52, 0.35, 0.3))


def looked_at(primitives, elevations=(20.0, 45.0)):
    """The fused mesh of boards, and what it was fused from, seen from above."""
    views = [seen(primitives, 0, c, 2 * VOXEL) for c in ring(12, 200, elevations=elevations)]
    space = (views, [STILL] * len(views), VOXEL)
    return fuse(views, space[1], 1, VOXEL, 4 * VOXEL, 2 * VOXEL), space


def pieces(mesh: Mesh) -> list[Mesh]:
    return sorted(connected(mesh), key=lambda p: -len(p.faces))


def test_a_leg_that_ends_out_of_sight_stays_and_is_joined():
    mesh, space = looked_at(boards(TOP, LEG))
    leg = pieces(mesh)[1]
    assert leg.vertices[:, 2].max() < 0.3 - VOXEL
    assert before_nothing(leg, mesh, *space)
    kept = without_crumbs(mesh, *space)
    assert len(connected(kept)) == 2 and len(largest_components(mesh).faces) < len(kept.faces)
    whole = bridged(kept, *space)
    assert np.array_equal(whole.vertices, kept.vertices) and np.array_equal(whole.faces[: len(kept.faces)], kept.faces)
    assert len(np.unique(components(whole))) == 1 and len(whole.faces) > len(kept.faces) + 8
    added = whole.vertices[whole.faces[len(kept.faces) :]]
    assert 0.2 < added[..., 2].min() and added[..., 2].max() < 0.3 + 0.06 + VOXEL  # from the leg's end to the top
    assert np.ptp(added[..., :2], axis=1).max() < 3 * VOXEL  # straight up
    label = components(kept)
    legs = np.unique(kept.faces[label == np.bincount(label).argmin()])
    edges = np.concatenate([whole.faces[:, [i, (i + 1) % 3]] for i in range(3)])
    edges = edges[np.isin(edges, legs).all(1)]
    assert len(np.unique(edges, axis=0)) == len(edges)  # what is added goes round as its neighbours do


def test_a_sheet_in_an_opening_is_a_crumb():
    sheet = ((0.3, -0.12, -0.1), (0.31, 0.12, 0.1))
    mesh, space = looked_at(CRATE + boards(sheet), elevations=(10.0, -10.0, 25.0))
    hung = next(p for p in pieces(mesh) if abs(p.vertices[:, 0].mean() - 0.3) < 0.05)
    assert not before_nothing(hung, mesh, *space)
    assert abs(without_crumbs(mesh, *space).vertices[:, 0] - 0.3).min() < VOXEL  # the crate's own walls
    middle = np.abs(without_crumbs(mesh, *space).vertices[:, 1:]).max(1) < 0.2
    assert not (middle & (without_crumbs(mesh, *space).vertices[:, 0] > 0.2)).any()


def test_what_is_seen_to_be_apart_is_kept_and_not_joined():
    mesh, space = looked_at(boards(TOP, ((0.7, 0.27, -0.25), (0.78, 0.35, 0.36))))
    kept = without_crumbs(mesh, *space)
    assert len(connected(kept)) == 2
    assert len(bridged(kept, *space).faces) == len(kept.faces)


@pytest.mark.parametrize("mesh", [Mesh.empty()])
def test_nothing_is_left_alone(mesh):
    assert without_crumbs(mesh, [], [], VOXEL) is mesh and bridged(mesh, [], [], VOXEL) is mesh
