"""The kernels of discovery against their twins in torch."""

from __future__ import annotations

import pytest
import torch

from p2gs.motion.discovery.config import DiscoveryConfig
from p2gs.motion.discovery.fields import Landing, Scale
from p2gs.motion.discovery.labels import Graph, smooth_labels, smooth_labels_reference
from p2gs.motion.discovery.pool import Pool, joint_sums, joint_sums_reference
from p2gs.motion.discovery.problem import Problem
from p2gs.motion.discovery.refine import normal_equations, normal_equations_reference
from p2gs.motion.discovery.rigid import Motions
from p2gs.types import Camera
from p2gs.visibility.depth_stack import DepthStack
from p2gs.visibility.surfels import Surfels


class NoViews(DepthStack):
    """Half of space is seen to be free, without any cameras."""

    def __init__(self):
        pass

    def spread(self, n):
        return torch.arange(0)

    def counts(self, points, tau, views=None):
        free = 5.0 * (points[:, 0] > 0.1)
        return free, torch.zeros_like(free), torch.zeros_like(free)


def surfels(n: int, seed: int) -> Surfels:
    """A rough box, faces outwards."""
    g = torch.Generator().manual_seed(seed)
    face = torch.arange(n) % 6
    p = torch.rand(n, 3, generator=g) - 0.5
    normals = torch.eye(3)[face % 3] * torch.where(face < 3, 1.0, -1.0)[:, None]
    p[torch.arange(n), face % 3] = torch.where(face < 3, 0.5, -0.5)
    normals = torch.nn.functional.normalize(normals + 0.1 * torch.randn(n, 3, generator=g), dim=1)
    return Surfels(p + 0.003 * torch.randn(n, 3, generator=g), normals, torch.rand(n, 3, generator=g), 0.05, 0.004)


def make_problem(n: int = 700, cells: float = 6000.0) -> Problem:
    both = [surfels(n, s) for s in (0, 1)]
    lo, hi = torch.full((3,), -0.55), torch.full((3,), 0.56)
    scale = Scale(tau=0.02, tp=0.02, spacing=0.05, diag=1.9)
    static = [torch.arange(n) % 3 == s for s in (0, 1)]
    moved = [torch.arange(n) % 3 == 2 for _ in (0, 1)]
    landings = [Landing(both[s], static[s], NoViews(), lo, hi, scale, cells) for s in (0, 1)]
    samples = [torch.nonzero(m)[:, 0] for m in moved]
    weights = [torch.rand(len(s)) / len(s) for s in samples]
    trust = [torch.ones(n) for _ in (0, 1)]
    return Problem(
        DiscoveryConfig(),
        scale,
        [],
        both,
        moved,
        static,
        landings,
        samples,
        weights,
        trust,
        torch.zeros(3),
        [~m & False for m in moved],
    )


def make_motions(n: int, reach: float = 0.6) -> Motions:
    """Turns and slides, the first ones small: the rest lands partly outside the grids."""
    amount = torch.linspace(0.01, reach, n) * torch.where(torch.arange(n) % 3 == 0, -1.0, 1.0)
    axis = torch.nn.functional.normalize(torch.randn(n, 3), dim=1)
    thick = torch.tensor([0.0, 0.03, 0.1])[torch.arange(n) % 3]
    return Motions(torch.arange(n) % 2 == 0, axis, torch.rand(n, 3) - 0.5, amount, thick)


def twin(problem: Problem, motions: Motions, state: int, index, claimed=None):
    s, back = problem.surfels[state], state == 1
    x, n = motions.apply(s.points[index], back), motions.rotate(s.normals[index], back)
    return problem.landings[1 - state].cost(
        x, n, s.colours[index], claimed, motions.thick[:, None].expand(x.shape[:-1])
    )


def assert_alike(problem: Problem, motions: Motions, state: int, index, claimed=None):
    """Rounding may carry a point into the next voxel, and there it may meet another surfel."""
    cost, met = problem.cost(motions, state, index, claimed)
    expected, surfel = twin(problem, motions, state, index, claimed)
    assert (
        cost.dtype == torch.float32
        and met.dtype == torch.int64
        and cost.shape == met.shape == (len(motions), len(index))
    )
    same = met == surfel
    close = (cost - expected).abs() < 2e-4
    if cost.numel():
        assert float(same.float().mean()) > 0.998
        assert float(close.float().mean()) > 0.998


@pytest.mark.parametrize("B, P", [(1, 1), (1, 700), (3, 17), (9, 300), (40, 64), (20, 600)])
@pytest.mark.parametrize("claimed", [False, True])
def test_landing_cost_against_torch(isa, threads, B, P, claimed):
    problem = make_problem()
    index = torch.randperm(700)[:P]
    for state in (0, 1):
        for reach in (0.02, 0.6, 30.0):
            assert_alike(problem, make_motions(B, reach), state, index, torch.rand(700) if claimed else None)


def test_a_plate_shows_its_other_side(isa):
    """A slab turned half about its edge: the side that one state saw lands a thickness behind the one that the other
    state sees."""
    g = torch.Generator().manual_seed(0)
    p = torch.rand(700, 3, generator=g) - 0.5
    front, back = p.clone(), p.clone()
    front[:, 0], back[:, 0] = -0.2, -0.24  # in free space nowhere (``NoViews`` sees x > 0.1)
    facing = torch.tensor([1.0, 0.0, 0.0]).expand(700, 3)
    both = [
        Surfels(front, facing, torch.zeros(700, 3), 0.05, 0.004),
        Surfels(back, -facing, torch.ones(700, 3), 0.05, 0.004),
    ]
    lo, hi = torch.full((3,), -0.55), torch.full((3,), 0.56)
    scale, none = Scale(tau=0.02, tp=0.02, spacing=0.05, diag=1.9), torch.zeros(700, dtype=torch.bool)
    source, target = (Landing(s, none, NoViews(), lo, hi, scale, 6000.0) for s in both)
    still = Motions(
        torch.ones(3, dtype=torch.bool), facing[:3], torch.zeros(3, 3), torch.zeros(3), torch.tensor([0.0, 0.04, 0.3])
    )
    cost, met = target.arrive(still, source, torch.arange(700))
    assert float((cost[0] - Landing.HIDDEN).abs().max()) < 1e-6  # who knows one side only: hidden
    assert float((cost[1] - Landing.TWO_SIDED).abs().mean()) < 0.02 and bool((met[1] >= 0).all())
    assert float((cost[2] - Landing.HIDDEN).abs().max()) < 1e-6  # too thick: nothing is there


def test_landing_cost_spans_its_range(isa):
    """The twins agree about something: all kinds of landings are among those compared."""
    problem = make_problem()
    cost, _ = problem.cost(make_motions(30), 0, torch.arange(700))
    assert (
        float(cost.min()) < 0.1
        and float(cost.max()) == 1.0
        and float(((cost > 0.34) & (cost < 0.36)).float().mean()) > 0.05
    )


@pytest.mark.parametrize("B, P", [(0, 5), (5, 0), (0, 0)])
def test_nothing_to_land(isa, B, P):
    problem = make_problem(100)
    cost, met = problem.cost(make_motions(B), 1, torch.arange(P))
    assert cost.shape == met.shape == (B, P) and met.dtype == torch.int64


def test_strided_views_are_taken(isa):
    problem = make_problem()
    m = make_motions(1)
    many = Motions(m.turn.expand(6), m.axis.expand(6, 3), m.centre.expand(6, 3), torch.linspace(-0.1, 0.1, 12)[::2])
    assert_alike(problem, many, 0, torch.arange(0, 700, 3))
    assert_alike(problem, many, 0, torch.arange(700)[::5])


def test_a_surfel_that_does_not_exist(isa):
    problem = make_problem(100)
    for wrong in (100, -1):
        with pytest.raises(IndexError):
            problem.cost(make_motions(2), 0, torch.tensor([3, wrong]))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e38])
def test_what_is_not_finite_stays_within_the_tables(isa, bad):
    problem = make_problem()
    motions = make_motions(20)
    motions.amount[3], motions.centre[5, 1], motions.axis[7, 2] = bad, bad, bad
    for state in (0, 1):
        cost, met = problem.cost(motions, state, torch.arange(700))
        assert bool(((met >= 0) & (met < 700)).all())
        fine = torch.tensor([i for i in range(20) if i not in (3, 5, 7)])
        assert bool(cost[fine].isfinite().all()) and bool(((cost >= 0) & (cost <= 1))[fine].all())
        normal_equations(problem, motions, problem.samples, problem.weights, 0.1)


def test_same_bits_for_any_number_of_threads(isa):
    problem, motions = make_problem(1500), make_motions(37)
    answers = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        answers.append(
            [
                *problem.cost(motions, 0, torch.arange(1500)),
                *problem.cost(motions[5:6], 1, torch.arange(1500)),
                *normal_equations(problem, motions, problem.samples, problem.weights, 0.1),
            ]
        )
    for other in answers[1:]:
        assert all(torch.equal(a, b) for a, b in zip(answers[0], other, strict=True))


@pytest.mark.parametrize("width", [0.3, 0.02])
def test_normal_equations_against_torch(isa, threads, width):
    """Few enough points that no rounding carries one into the next voxel."""
    problem, motions = make_problem(), make_motions(11, 0.2)
    got = normal_equations(problem, motions, problem.samples, problem.weights, width)
    expected = normal_equations_reference(problem, motions, problem.samples, problem.weights, width)
    for a, b in zip(got, expected, strict=True):
        wrong = (a - b).abs().flatten(1).amax(1) > 1e-3 * b.abs().flatten(1).amax(1).clamp_min(1e-6)
        assert int(wrong.sum()) <= 1
    assert torch.equal(got[0], got[0].transpose(1, 2)) and float(got[0].abs().max()) > 1e-3
    none = [torch.zeros(0, dtype=torch.long)] * 2
    for x in normal_equations(problem, motions, none, [torch.zeros(0)] * 2, width):
        assert not x.any()


def test_torch_takes_over_where_there_are_no_kernels(monkeypatch):
    problem, motions, index = make_problem(), make_motions(5), torch.arange(300)
    monkeypatch.setattr("p2gs.motion.discovery.fields.native", None)
    for state in (0, 1):
        for a, b in zip(problem.cost(motions, state, index), twin(problem, motions, state, index), strict=True):
            assert torch.equal(a, b)
    a, b = (
        f(problem, motions, problem.samples, problem.weights, 0.1)
        for f in (normal_equations, normal_equations_reference)
    )
    assert torch.equal(a[0], b[0]) and torch.equal(a[1], b[1])


@pytest.mark.parametrize("columns", [1, 2, 5, 8, 9, 16, 17, 32, 33])
@pytest.mark.parametrize("n", [2, 37, 1200])
def test_labels_on_a_graph_against_torch(isa, threads, n, columns):
    s = surfels(n, 2)
    graph = Graph(s.points, s.normals, s.colours)
    cost = torch.rand(n, columns)
    settings = dict(diffuse=8, rounds=15, pull=2.5, sharp=12.0)
    torch.testing.assert_close(
        smooth_labels(cost, graph), smooth_labels_reference(cost, graph, **settings), atol=5e-5, rtol=0
    )
    torch.testing.assert_close(graph.average(cost.double()).float(), graph.average(cost), atol=1e-6, rtol=1e-5)


def test_labels_are_sure_where_costs_are_far_apart_or_infinite(isa):
    s = surfels(300, 2)
    graph = Graph(s.points, s.normals, s.colours)
    cost = torch.zeros(300, 3)
    cost[:, 1:] = 1e6
    assert torch.equal(smooth_labels(cost, graph), torch.eye(3)[0].expand(300, 3))
    cost[5, 1], cost[9, 0] = float("inf"), float("nan")
    assert smooth_labels(cost, graph).shape == (300, 3)


def test_labels_are_the_same_for_any_number_of_threads(isa):
    s = surfels(3000, 2)
    graph, cost, answers = Graph(s.points, s.normals, s.colours), torch.rand(3000, 5), []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        answers.append((smooth_labels(cost, graph), graph.average(cost)))
    for other in answers[1:]:
        assert torch.equal(other[0], answers[0][0]) and torch.equal(other[1], answers[0][1])


def make_stack(views: int = 6) -> DepthStack:
    """Rough depth maps with holes, of two sizes, from all around."""
    cameras, depths, alphas = [], [], []
    for v in range(views):
        h, w = ((48, 64), (40, 50))[v % 2]
        Q, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3], viewmat[2, 3] = Q * torch.sign(torch.linalg.det(Q)), 2.0
        K = torch.tensor([[60.0, 0, w / 2], [0, 55.0, h / 2], [0, 0, 1]], dtype=torch.float64)
        cameras.append(Camera(viewmat=viewmat, K=K, width=w, height=h))
        depths.append(1.5 + torch.rand(h, w))
        alphas.append((torch.rand(h, w) > 0.2).float())
    return DepthStack(depths, alphas, cameras)


@pytest.mark.parametrize("n", [0, 1, 31, 5000])
def test_view_counts_against_torch(isa, threads, n):
    """Rounding may carry a point into the next pixel."""
    stack, points = make_stack(), torch.randn(n, 3)
    for views in (torch.arange(6), torch.tensor([4, 1]), torch.arange(0)):
        got, expected = (
            torch.stack(stack.counts(points, 0.05, views)),
            torch.stack(stack.counts_reference(points, 0.05, views)),
        )
        assert got.shape == (3, n) and got.dtype == torch.float32
        if n:
            assert int((got != expected).any(0).sum()) <= n // 500
    if n == 5000:
        assert bool((torch.stack(stack.counts(points, 0.05)).sum(1) > 500).all())


@pytest.mark.parametrize("n", [0, 1, 31, 5000])
def test_view_directions_against_torch(isa, threads, n):
    """A point that rounding carries into the next pixel may be seen by one camera more or less."""
    stack, points = make_stack(), torch.randn(n, 3)
    got, expected = stack.seen_from(points, 0.05), stack.seen_from_reference(points, 0.05)
    assert got.shape == (n, 3) and got.dtype == torch.float32
    assert int(((got - expected).abs().amax(1) > 1e-5).sum()) <= n // 500 if n else True
    if n == 5000:
        assert int((expected.norm(dim=1) > 0.5).sum()) > 100


def test_view_counts_of_what_is_not_finite(isa):
    stack, points = make_stack(), torch.randn(40, 3)
    points[3], points[7, 1], points[20, 2] = float("nan"), float("inf"), -float("inf")
    points[30] = 3e38
    free, on, behind = stack.counts(points, 0.05)
    assert float((free + on + behind)[[3, 7, 20]].sum()) == 0
    with pytest.raises(IndexError):
        stack.counts(points, 0.05, torch.tensor([0, 6]))


def test_view_counts_are_the_same_for_any_number_of_threads(isa):
    stack, points, answers = make_stack(), torch.randn(9001, 3), []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        answers.append(torch.stack(stack.counts(points, 0.05)))
    assert all(torch.equal(a, answers[0]) for a in answers)


def test_motions_against_torch():
    motions = make_motions(40)
    motions.axis[:6] = torch.eye(3)[[0, 1, 2, 0, 1, 2]]
    motions.amount[2:4], step = 0.0, torch.randn(40, 5) * 0.2
    step[3:8] = 0.0
    for a, b in zip(motions.matrices(), motions.matrices_reference(), strict=True):
        torch.testing.assert_close(a, b, atol=2e-6, rtol=0)
    a, b = motions.displaced(step), motions.displaced_reference(step)
    for name in ("axis", "centre", "amount"):
        torch.testing.assert_close(getattr(a, name), getattr(b, name), atol=2e-6, rtol=0)
    assert torch.equal(a.turn, b.turn)
    assert len(Motions.empty().displaced(torch.zeros(0, 5))) == 0 and len(Motions.empty().matrices()[0]) == 0


def test_joints_against_torch(isa, threads):
    problem, motions = make_problem(), make_motions(33)
    pays = [p for p, _ in problem.pay(motions)]
    pays[0][2:9], pays[1][5:12] = 0.0, 0.0
    for p, samples in ((pays, problem.samples), ([p[:, :7] for p in pays], [s[:7] for s in problem.samples])):
        for a, b in zip(
            joint_sums(problem, motions, p, samples), joint_sums_reference(problem, motions, p, samples), strict=True
        ):
            torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4)
    none, nothing = [torch.zeros(0, dtype=torch.long)] * 2, [torch.zeros(33, 0)] * 2
    for a, b in zip(
        joint_sums(problem, motions, nothing, none), joint_sums_reference(problem, motions, nothing, none), strict=True
    ):
        assert torch.equal(a, b)


def test_effective_evidence_against_torch(isa, threads):
    problem = make_problem()
    pool = Pool(problem, problem.samples)
    pool.add(make_motions(30, 0.1))
    pool.pays = [torch.rand_like(p) for p in pool.pays]
    pool.back = [torch.rand_like(b) for b in pool.back]
    pool.owned = [torch.rand_like(p) > 0.5 for p in pool.pays]
    others = pool.best([3, 5])
    for rows in (torch.arange(30), torch.tensor([7, 7, 0]), torch.tensor([], dtype=torch.long)):
        for a, b in zip(pool.effective(rows, others), pool.effective_reference(rows, others), strict=True):
            torch.testing.assert_close(a, b, atol=1e-6, rtol=1e-5)


def test_swept_distances_against_torch():
    motions, points = make_motions(30), torch.randn(120, 3)
    torch.testing.assert_close(
        motions.swept(points, motions[3:9]), motions.swept_reference(points, motions[3:9]), atol=2e-6, rtol=1e-5
    )
    assert motions.swept(points, motions).diagonal().abs().max() < 1e-6
    assert Motions.empty().swept(points, motions).shape == (0, 30)


def test_a_sets_evidence_against_torch(monkeypatch):
    problem = make_problem()
    pool = Pool(problem, problem.samples)
    pool.add(make_motions(30, 0.1))
    pool.pays, pool.loose = [torch.rand_like(p) for p in pool.pays], [torch.rand_like(p) > 0.5 for p in pool.pays]
    sets = [[4], [3, 7, 20], list(range(12))]
    got = [pool.total(s) for s in sets]
    monkeypatch.setattr("p2gs.motion.discovery.pool.native", None)
    assert got == pytest.approx([pool.total(s) for s in sets], rel=1e-5) and min(got) > 0.1
