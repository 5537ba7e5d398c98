"""Boards inside are found where colours of many photographs agree, and nowhere else."""

import math
from dataclasses import replace

import pytest
import torch
from test_openings import BOX, DARK, INSIDE, panel, scene

from p2gs.surface.boards import FEW, Board, Rays, disagreement, find_boards
from p2gs.surface.openings import OneState, OpeningsConfig
from p2gs.surface.walls import Walls

LO, HI = torch.tensor([-0.5, -0.5, -0.5]).double(), torch.tensor([0.5, 0.5, 0.5]).double()


def coloured(points):
    """A colour of its own for each place: waves of about 0.2."""
    phase = points.double() @ torch.tensor([[31.0, 9, 4], [7, 29, 5], [3, 8, 33]]).double()
    return 0.5 + 0.4 * torch.sin(phase)


def down(boards, n=30_000, noise=0.05, seed=0):
    """Rays from a lid (z = 0.4) down into a box, with the colours of the highest of ``boards`` (z, x from, x to) below,
    or of the box."""
    g = torch.Generator().manual_seed(seed)
    start = torch.rand(n, 3, generator=g).double() * 0.8 - 0.4
    start[:, 2] = 0.4
    way = torch.randn(n, 3, generator=g).double() * 0.6
    way[:, 2] = -1
    way = torch.nn.functional.normalize(way, dim=1)
    far = torch.where(way > 0, (HI - start) / way, (LO - start) / way).amin(1)
    end = far.clone()
    for z, x0, x1 in boards:
        t = (z - start[:, 2]) / way[:, 2]
        x = start[:, 0] + t * way[:, 0]
        end = torch.where((t < end) & (x > x0) & (x < x1), t, end)
    colour = coloured(start + end[:, None] * way) + noise * torch.randn(n, 3, generator=g)
    return Rays(start, way, far, colour, torch.zeros(n, dtype=torch.int64)), end


@pytest.mark.parametrize("stay", [True, False])
def test_a_shelf_is_found_at_its_height_and_no_wider_than_it_is(stay):
    rays, end = down([(0.07, -0.5, 0.1)])
    board = find_boards(rays, LO, HI, 0.04, stay)[0]
    assert board.axis == 2 and board.offset == pytest.approx(0.07, abs=0.006)
    t = board.meet(rays, 0.04)
    on = end < rays.far - 1e-9
    assert (t.isfinite() == on).double().mean() > 0.95
    torch.testing.assert_close(t[on & t.isfinite()], end[on & t.isfinite()], atol=0.02, rtol=0)


def test_one_shelf_above_the_other():
    found = find_boards(down([(0.2, 0.0, 0.5), (-0.1, -0.5, 0.5)])[0], LO, HI, 0.04, False)
    assert sorted(round(b.offset, 1) for b in found if b.axis == 2)[-2:] == [-0.1, 0.2]


def test_an_empty_box_has_none():
    rays = down([])[0]
    assert find_boards(rays, LO, HI, 0.04, False) == []
    assert find_boards(rays[torch.arange(FEW - 1)], LO, HI, 0.04, False) == []


def test_where_the_lid_itself_agrees_nothing_behind_it_counts():
    rays, _ = down([])
    rays = replace(
        rays,
        colour=coloured(rays.start) + 0.01 * torch.randn(len(rays.far), 3, generator=torch.Generator().manual_seed(3)),
    )
    assert find_boards(rays, LO, HI, 0.04, True) == []
    assert find_boards(rays, LO, HI, 0.04, False)  # better than at the walls all the same


def test_disagreement_is_the_variance_of_each_cell():
    g = torch.Generator().manual_seed(0)
    cells, colours = torch.randint(0, 40, (100,), generator=g), torch.rand(100, 3, generator=g)
    cells[0] = 99
    out = disagreement(cells, colours)
    assert math.isnan(float(out[0]))
    for i in range(1, 100):
        mine = colours[cells == cells[i]].double()
        assert len(mine) == 1 or float(out[i]) == pytest.approx(float(mine.var(0).sum()), rel=1e-6)


def test_a_board_is_met_within_its_mask_before_the_rays_end():
    mask = torch.zeros(4, 4, dtype=torch.bool)
    mask[1, 2] = True  # y from 0.03 to 0.06, z from 0.06 to 0.09
    board = Board(0, 1.0, torch.zeros(2).double(), mask)
    start = torch.tensor(
        [[0.0, 0.04, 0.07], [0.0, 0.01, 0.07], [0.99, 0.04, 0.07], [0.0, 0.04, 0.07], [2.0, 0.04, 0.07]]
    ).double()
    rays = Rays(
        start,
        torch.eye(3).double()[[0] * 5],
        torch.tensor([5.0, 5, 5, 0.5, 5]).double(),
        torch.zeros(5, 3),
        torch.zeros(5).long(),
    )
    assert board.meet(rays, 0.04).tolist() == [1.0, math.inf, math.inf, math.inf, math.inf]
    along = replace(rays, way=torch.eye(3).double()[[1] * 5])  # in the plane's direction
    assert board.meet(along, 0.04).isinf().all()


def test_a_backdrop_has_the_shelf_that_only_the_photographs_know(monkeypatch):
    monkeypatch.setattr("p2gs.surface.boards.FEW", 500)  # the pictures are small
    lid = panel([-0.37, 0.2, -0.27], [0.74, 0, 0], [0, 0, 0.54], DARK)
    shelf = panel([-0.37, -0.27, -0.05], [0.74, 0, 0], [0, 0.57, 0], lambda p: coloured(0.5 * p).float(), step=0.02)
    states, motions, views, stacks = scene(lid, [*(panel(*side, DARK) for side in INSIDE), shelf])
    g = states[1].gaussians
    lids = torch.arange(len(g)) >= len(g) - len(lid)
    outside = torch.cat([panel(*side, DARK).means for side in BOX])
    walls = Walls(outside, outside.amin(0), outside.amax(0), 0.02)

    def on_shelf(config):
        state = OneState(
            g, lids, torch.zeros_like(lids), torch.zeros(len(g), dtype=torch.int64), views[1], config, "auto", "cpu"
        )
        points = [b.points for b in state.backdrops(walls, stacks)]
        return [
            int((((p - torch.tensor([0.0, -0.05, -0.04])).abs() < torch.tensor([0.3, 0.15, 0.02])).all(1)).sum())
            for p in points
        ]

    assert on_shelf(OpeningsConfig(boards=False)) == [0]
    without, *found = on_shelf(OpeningsConfig())
    assert without == 0 and len(found) == 2 and min(found) > 60
