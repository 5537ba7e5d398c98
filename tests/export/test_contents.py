"""What lies on or in an open drawer's tray is the drawer's, whatever else it was taken for; what only seems to is left
alone."""

import numpy as np
import pytest
import torch
from test_openings import panel
from toy import ring

from p2gs.gaussians.pose import pose
from p2gs.models.finish import assemble
from p2gs.ops import se3
from p2gs.surface.contents import belongs, beside, in_trays, out_of_body
from p2gs.surface.trays import Front, Tray
from p2gs.types import GaussianTensors, Similarity

GREY = [0.5, 0.5, 0.5]
TRAVEL = 0.35
BODY = [  # open to +x
    ([-0.5, -0.4, -0.3], [0, 0.8, 0], [0, 0, 0.6]),
    ([-0.5, -0.4, -0.3], [1.0, 0, 0], [0, 0, 0.6]),
    ([-0.5, 0.4, -0.3], [1.0, 0, 0], [0, 0, 0.6]),
    ([-0.5, -0.4, -0.3], [1.0, 0, 0], [0, 0.8, 0]),
    ([-0.5, -0.4, 0.3], [1.0, 0, 0], [0, 0.8, 0]),
]
DRAWER = [  # shut
    ([0.52, -0.36, -0.2], [0, 0.72, 0], [0, 0, 0.4]),
    ([0.0, -0.32, -0.18], [0.5, 0, 0], [0, 0, 0.28]),
    ([0.0, 0.32, -0.18], [0.5, 0, 0], [0, 0, 0.28]),
    ([0.0, -0.32, -0.18], [0.5, 0, 0], [0, 0.64, 0]),
]
FLAP = ([-0.4, -0.4, 0.33], [0.5, 0, 0], [0, 0.8, 0])  # on top, turns up


def motions() -> torch.Tensor:
    slide = torch.eye(4, dtype=torch.float64)
    slide[0, 3] = TRAVEL
    return torch.stack(
        [slide, se3.from_screw(torch.tensor([0.0, 1, 0]).double(), torch.tensor([-0.4, 0, 0.33]).double(), -1.2)]
    )


def panels(sides):
    return GaussianTensors.cat([panel(*s, GREY) for s in sides])


def twin(time: float, shut_at: float):
    """The twin at canonical ``time`` with its drawer shut in state ``shut_at``; labels as they should be."""
    slide, flap = motions()
    if shut_at == 1:
        slide = se3.inverse(slide)
    groups = [panels(BODY), panels(DRAWER), panel(*FLAP, GREY)]
    labels = torch.cat([torch.full((len(g),), k) for k, g in enumerate(groups)])
    means = [groups[0].means, se3.apply(se3.screw_at(slide, time - shut_at), groups[1].means.double()).float()]
    means.append(se3.apply(se3.screw_at(flap, time), groups[2].means.double()).float())
    g = GaussianTensors.cat([x.placed(m, x.quats) for x, m in zip(groups, means, strict=True)])
    return assemble(g, labels, ["prismatic", "revolute"], torch.stack([slide, flap]), time, Similarity())


def in_the_drawer(obj, shut_at, drawn):
    """Where Gaussians are in the drawer's own coordinates, as it is shut, while it is open."""
    out = pose(obj, drawn).means.double()
    return se3.apply(se3.screw_at(obj.parts[1].joint.transform, shut_at - drawn), out)


@pytest.mark.parametrize("time, shut_at", [(0.0, 0.0), (1.0, 0.0), (0.3, 1.0)])
def test_patches_on_an_open_drawer_are_the_drawers(time, shut_at):
    obj, drawn = twin(time, shut_at), 1.0 - shut_at
    cameras = [(s, c) for s in (0, 1) for c in ring(10, 200, elevations=(15.0, 45.0))]
    labels, held = in_trays(obj, cameras)
    assert (
        torch.equal(labels, obj.part_ids) and (obj.part_ids[held] == 1).all() and held.sum() > 0.3 * (labels == 1).sum()
    )
    right = obj.part_ids.clone()
    at = in_the_drawer(obj, shut_at, drawn)
    side = (right == 1) & ((at[:, 1] - 0.32).abs() < 0.01) & (at[:, 0] > 0.2) & (at[:, 0] < 0.45) & (at[:, 2] < 0.0)
    assert int(side.sum()) > 10
    for wrong in (0, 2):  # labelled as another's, placed so that it is on the drawer's side while that is open
        obj.part_ids = torch.where(side, wrong, right)
        open_at = se3.apply(se3.screw_at(obj.parts[1].joint.transform, drawn - shut_at), at)
        stays = torch.eye(4).double() if wrong == 0 else se3.screw_at(obj.parts[2].joint.transform, time - drawn)
        obj.gaussians.means[side] = se3.apply(stays, open_at)[side].float()
        labels, again = in_trays(obj, cameras)
        assert torch.equal(labels, right) and (again == held).float().mean() > 0.98, wrong


def test_without_a_sliding_part_nothing_changes():
    obj = twin(0.0, 0.0)
    obj.parts = [obj.parts[0], obj.parts[2]]
    labels, held = in_trays(obj, [])
    assert torch.equal(labels, obj.part_ids) and not held.any()


def test_on_a_side_in_the_box_but_not_in_the_mouth():
    front = Front(np.eye(3), np.array([-0.4, -0.2]), np.array([0.4, 0.2]), 0.5)
    tray = Tray(front, np.array([-0.3, -0.3, -0.2]), np.array([0.5, 0.3, 0.1]), (1, 1), TRAVEL, 1, np.eye(4))
    points = {
        (0.2, 0.31, 0.0): True,  # a side's outside
        (0.2, 0.33, 0.0): False,
        (0.2, 0.0, -0.21): True,  # the bottom
        (0.2, 0.0, 0.0): True,  # what lies in it
        (0.2, 0.0, 0.09): False,  # a lid over it
        (0.2, 0.29, 0.09): True,  # a side's upper edge
        (0.2, 0.0, 0.2): False,
    }
    assert belongs(np.array(list(points)), tray, 0.02).tolist() == list(points.values())
    points = {
        (0.3, 0.36, 0.0): True,  # between the tray and the edge of what its front passed
        (0.3, 0.41, 0.0): False,
        (0.1, 0.36, 0.0): False,  # in the body
        (0.55, 0.36, 0.0): False,  # before the front
        (0.3, 0.0, -0.19): True,
        (0.3, 0.36, 0.15): False,  # before the mouth
        (0.3, 0.0, 0.09): False,
    }
    assert beside(np.array(list(points)), tray, 0.02).tolist() == list(points.values())
    assert out_of_body(np.array([[0.2, 0, 0], [0.16, 0, 0], [0.0, 0, 0]]), tray, 0.02).tolist() == [True, False, False]
