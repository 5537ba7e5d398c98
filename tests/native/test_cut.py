"""The least cut: the native kernel against all labellings and against scipy's maximum flow."""

import itertools

import numpy as np
import pytest

from p2gs.surface.cut import least_cut, least_cut_reference, solid_cells


def grid(shape):
    """Neighbours [N, 6] of the cells of a grid."""
    number = np.arange(np.prod(shape)).reshape(shape)
    out = np.full((number.size, 6), -1, np.int32)
    for axis in range(3):
        cells = np.moveaxis(number, axis, 0)
        out[cells[:-1].ravel(), 2 * axis] = cells[1:].ravel()
        out[cells[1:].ravel(), 2 * axis + 1] = cells[:-1].ravel()
    return out


def problem(shape, seed):
    rng = np.random.default_rng(seed)
    neighbours = grid(shape)
    capacity = np.where(neighbours >= 0, rng.integers(0, 6, neighbours.shape), 0).astype(np.int32)
    pull = rng.integers(-9, 10, len(neighbours)).astype(np.int32)
    pull[rng.random(len(pull)) < (seed % 4) / 4] = 0  # long ways between the terminals
    return neighbours, capacity, pull


def value(neighbours, capacity, pull, source):
    """Capacity of the cut around the nodes ``source`` [N] bool, summed edge by edge."""
    total = 0
    for i, row in enumerate(neighbours):
        total += max(pull[i], 0) if not source[i] else max(-pull[i], 0)
        total += sum(int(capacity[i, d]) for d, j in enumerate(row) if j >= 0 and source[i] and not source[j])
    return total


@pytest.mark.parametrize("cut", [least_cut, least_cut_reference])
@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 2, 2), (12, 1, 1), (2, 1, 3)])
def test_no_labelling_of_a_small_graph_costs_less(cut, shape):
    for seed in range(4):
        graph = problem(shape, seed)
        flow, side = cut(*graph)
        least = min(value(*graph, s) for s in itertools.product((False, True), repeat=len(graph[2])))
        assert flow == least == value(*graph, side == 1) == value(*graph, side != 0)


@pytest.mark.parametrize("seed", range(12))
def test_follows_maximum_flow(seed):
    graph = problem((9, 8, 7), seed)
    flow, side = least_cut(*graph)
    expected, sides = least_cut_reference(*graph)
    assert flow == expected and np.array_equal(side, sides)


def test_what_goes_in_is_left_alone():
    graph = problem((4, 4, 4), 1)
    before = [x.copy() for x in graph]
    least_cut(*graph)
    assert all(np.array_equal(a, b) for a, b in zip(graph, before, strict=True))


def test_solid_cells_cost_least_of_all_sets():
    """Votes against what is solid, for what is not, and faces, counted for each of the 4,096 sets of 12 cells."""
    active = np.zeros((4, 4, 5), bool)
    active[1:3, 1:3, 1:4] = True
    inside = np.argwhere(active)
    for seed in range(3):
        votes = np.random.default_rng(seed).integers(-64, 65, active.shape) / 64

        def cost(solid, votes=votes):
            faces = sum(int((np.diff(solid, axis=a)).sum()) for a in range(3))
            return (
                float(-votes[active & solid].clip(max=0).sum() + votes[active & ~solid].clip(min=0).sum())
                + 0.25 * faces
            )

        best = []
        for bits in itertools.product((False, True), repeat=len(inside)):
            solid = np.zeros(active.shape, bool)
            solid[tuple(inside[list(bits)].T)] = True
            best.append((cost(solid), -int(solid.sum())))
        found = solid_cells(votes, active, 0.25)
        assert (cost(found), -int(found.sum())) == min(best) and not found[~active].any()
