"""The parts of discovery against slow readable twins."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from boxes import PLAIN, both, door, drawer, shell

from p2gs.data.generated.articulated import SyntheticPart, revolute
from p2gs.data.generated.furniture import box
from p2gs.motion.discovery.amounts import parted
from p2gs.motion.discovery.config import DiscoveryConfig
from p2gs.motion.discovery.explanations import HINGE, extended, finish, ranked, total_score, unlikely_hinges
from p2gs.motion.discovery.fields import Landing
from p2gs.motion.discovery.finish import Explanation
from p2gs.motion.discovery.hypotheses import Sweep, static_axes, sweep
from p2gs.motion.discovery.labels import ELSEWHERE, REVEALED, Graph, Labelling, arrivals, label, unary, unlike
from p2gs.motion.discovery.pipeline import discover
from p2gs.motion.discovery.problem import build_problem, evidence_masks, resampled
from p2gs.motion.discovery.proposals import as_motions, relabel
from p2gs.motion.discovery.refine import pattern_search
from p2gs.motion.discovery.rigid import Motions, axes_used, same_place
from p2gs.motion.discovery.rows import rows
from p2gs.motion.discovery.search import Search
from p2gs.motion.discovery.verify import image_score, light_of, violation
from p2gs.motion.light import TurnedLight
from p2gs.ops import se3
from p2gs.visibility.depth_stack import DepthStack, classify
from p2gs.visibility.surfels import Surfels, window_planes


def counts_naive(stack: DepthStack, points, tau):
    """One point, one view at a time."""
    out = np.zeros((3, len(points)))
    for n, p in enumerate(points.double()):
        for v, camera in enumerate(stack.cameras):
            x, y, z = (camera.viewmat[:3, :3].double() @ p + camera.viewmat[:3, 3].double()).tolist()
            if z <= 0:
                continue
            u, w = camera.K[0, 0] * x / z + camera.K[0, 2], camera.K[1, 1] * y / z + camera.K[1, 2]
            col, row = math.floor(u), math.floor(w)
            if not (0 <= col < camera.width and 0 <= row < camera.height):
                continue
            seen = []
            for i in range(max(row - 1, 0), min(row + 2, camera.height)):
                for j in range(max(col - 1, 0), min(col + 2, camera.width)):
                    seen.append(float(stack.depth[v, i, j]) if stack.valid[v, i, j] else math.inf)
            kind = 0 if z < min(seen) - tau else 2 if z > max(seen) + tau else 1
            out[kind, n] += 1
    return torch.from_numpy(out).float()


def test_free_on_behind_counts_match_the_slow_twin():
    (start, end), _ = both(shell(door(-0.6, 0.6, -0.6, 0.6, True, 50)), views=6, size=60, points=800)
    stack = DepthStack(end.depths, end.alphas, end.cameras)
    generator = torch.Generator().manual_seed(0)
    points = torch.cat([start.points[:150], torch.rand(50, 3, generator=generator) * 4 - 2])
    fast, slow = torch.stack(stack.counts(points, 0.02)), counts_naive(stack, points, 0.02)
    assert slow.sum(1).min() > 50
    assert float((fast != slow).any(0).float().mean()) < 0.02  # float32 against float64 at pixel borders


def test_views_of_different_size_are_counted_alike():
    """A view cropped to its upper left says of points inside the crop what the whole view says, and nothing of the
    others."""
    (start, end), _ = both(shell(door(-0.6, 0.6, -0.6, 0.6, True, 50)), views=4, size=60, points=600)
    keep = [(40, 60), (60, 45), (60, 60), (50, 50)]
    cameras = [c.cropped(0, 0, w, h) for c, (h, w) in zip(end.cameras, keep, strict=True)]
    crop = DepthStack(
        [d[:h, :w] for d, (h, w) in zip(end.depths, keep, strict=True)],
        [a[:h, :w] for a, (h, w) in zip(end.alphas, keep, strict=True)],
        cameras,
    )
    whole = DepthStack(end.depths, end.alphas, end.cameras)
    views = torch.arange(4)
    _, _, inside = crop.project(start.points, views)
    assert 0 < int((~inside).sum()) < inside.numel()
    for v in range(4):
        one = torch.tensor([v])
        a, b = torch.stack(crop.counts(start.points, 0.02, one)), torch.stack(whole.counts(start.points, 0.02, one))
        h, w = keep[v]
        x, y = (whole.project(start.points, one)[1][:, 0] % 60), (whole.project(start.points, one)[1][:, 0] // 60 % 60)
        deep = inside[:, v] & (x < w - 1) & (y < h - 1)
        assert torch.equal(a[:, deep], b[:, deep])
        assert float(a[:, ~inside[:, v]].sum()) == 0


def test_seen_through_is_moved_and_covered_is_unknown():
    obj = shell(door(-0.6, 0.6, -0.6, 0.6, True, 70))
    (start, end), (part, _) = both(obj)
    problem, _ = build_problem(start, end, DiscoveryConfig(surfels=4000), 0)
    end_points, start_points = problem.surfels[1].points, problem.surfels[0].points
    # of the cupboard, shut away at the start
    inside = (end_points[:, 0] < -0.2) & (end_points[:, 1:].abs().max(1).values < 0.3)
    assert int(inside.sum()) > 30
    assert not bool((problem.moved[1] & inside).any())
    front = start_points[:, 0] > float(start.points[part == 1][:, 0].quantile(0.3))
    assert float(problem.moved[0][front].float().mean()) > 0.7


def test_ranking_is_by_score_without_the_same_motions_again():
    torch.manual_seed(0)
    a, b = random_motions(2), random_motions(3)
    search = SimpleNamespace(probe=torch.randn(50, 3), radius=0.05)
    search.agree = lambda x, y: Search.agree(search, x, y)
    make = lambda score, m: Explanation(m, Labelling([], []), score)  # noqa: E731
    order = ranked(search, [make(0.3, a), make(0.25, b), make(0.2, a[torch.tensor([1, 0])]), make(0.75, a[:1])])
    assert [(e.score, len(e.motions)) for e in order] == [(0.2, 2), (0.25, 3), (0.75, 1)]


@pytest.fixture(scope="module")
def stacked():
    """Two stacked doors on one hinge, 36 and 30 degrees open: what they are as one motion whose hinge tilts, and the
    truth."""
    obj = shell(door(-0.6, 0.6, -0.62, -0.02, True, 36), door(-0.6, 0.6, 0.02, 0.62, True, 30))
    (start, end), _ = both(obj)
    problem, _ = build_problem(start, end, DiscoveryConfig(surfels=4000), 0)
    T = torch.stack([torch.from_numpy(part.pose(1.0) @ np.linalg.inv(part.pose(0.0))) for part in obj.parts[1:]])
    truth = as_motions(T, ["revolute"] * 2)
    truth = truth[truth.amount.abs().argsort()]
    mean = Motions(truth.turn[:1], truth.axis[:1], truth.centre[:1], truth.amount.mean()[None])
    tilt = 0.05 * torch.linalg.cross(mean.axis, torch.tensor([[0.0, 1.0, 0.0]]))
    tilted = Motions(mean.turn, torch.nn.functional.normalize(mean.axis + tilt, dim=1), mean.centre, mean.amount)
    return problem, [Graph(s.points, s.normals, s.colours) for s in problem.surfels], tilted, truth


def test_stacked_doors_are_two_amounts_about_one_axis(stacked):
    problem, graphs, tilted, truth = stacked
    labelling = label(problem, tilted, graphs)
    alone = total_score(problem, tilted, labelling)
    found = parted(problem, graphs, labelling, tilted, 0, static_axes(problem))
    assert [len(m) for m in found] == [2] * len(found) and len(found) >= 2  # about its own axis, and about the upright
    scores = [total_score(problem, m, label(problem, m, graphs)) for m in found]
    best = found[scores.index(min(scores))]
    assert min(scores) < alone and float((best.axis[0] @ truth.axis[0]).abs()) > 0.9999
    off = (best.amount.abs().sort().values - truth.amount.abs()).abs() * 180 / math.pi
    assert float(off.max()) < 1.5


def test_a_part_that_the_search_did_without_is_added_and_no_more(stacked):
    problem, graphs, _, truth = stacked
    axes = static_axes(problem)
    search = Search(problem, sweep(problem, axes[:1]), 4, problem.config.part_cost)
    near = replace(truth, amount=truth.amount * torch.tensor([1.05, 0.95]))
    search.pool.add(Motions.cat([near, random_motions(6)]))
    one = finish(problem, graphs, near[:1], 4, axes)
    assert len(one.motions) == 1
    both = extended(problem, graphs, search, one, 4, axes)
    assert len(both.motions) == 2 and both.score < one.score
    off = (both.motions.amount.abs().sort().values - truth.amount.abs()).abs() * 180 / math.pi
    assert float(off.max()) < 1.5
    assert extended(problem, graphs, search, both, 4, axes) is both
    assert extended(problem, graphs, search, one, 1, axes) is one  # no more than the limit


def test_one_door_stays_one():
    (start, end), _ = both(shell(door(-0.6, 0.6, -0.6, 0.6, True, 40)))
    found = discover(start, end, "auto", DiscoveryConfig(surfels=4000, searches=1))
    assert len(found.motions) == 1
    problem, motions = found.problem, as_motions(found.motions[0].transform[None], ["revolute"])
    labelling = label(problem, motions, found.graphs)
    alone = total_score(problem, motions, labelling)
    two = parted(problem, found.graphs, labelling, motions, 0, static_axes(problem))
    assert all(total_score(problem, m, label(problem, m, found.graphs)) > alone for m in two)


def test_where_a_part_lands_on_another_it_is_as_wrong_as_in_empty_space(stacked):
    problem, graphs, _, truth = stacked
    right = label(problem, truth, graphs)
    swapped = Labelling([right.probability[0][:, [0, 2, 1]], right.probability[1]], right.cost)
    index = (right.labels(1) == 1).nonzero()[:, 0]
    good = violation(problem, truth, right, 1, index)
    assert (
        float(good.mean()) < 0.35
        and float(violation(problem, truth, swapped, 1, index).mean()) > float(good.mean()) + 0.1
    )
    lost = Labelling([torch.eye(3)[torch.zeros(len(p), dtype=torch.long)] for p in right.probability], right.cost)
    moved = problem.moved[1].nonzero()[:, 0]
    assert bool((violation(problem, truth, lost, 1, moved) == 1).all())  # what moved is called static


def test_that_more_is_said_to_move_makes_an_explanation_no_better(stacked):
    problem, graphs, tilted, _ = stacked
    still = Motions(tilted.turn, tilted.axis, tilted.centre, torch.zeros(1))
    motions, wrong = Motions.cat([tilted, still]), label(problem, tilted, graphs)
    nobody = [torch.cat([p, torch.zeros(len(p), 1)], 1) for p in wrong.probability]
    everybody = [torch.cat([torch.zeros(len(p), 1), p[:, 1:], p[:, :1]], 1) for p in wrong.probability]
    few, many = (image_score(problem, motions, Labelling(p, wrong.cost)) for p in (nobody, everybody))
    assert few > 0.02 and many >= few - 1e-6


def swung_plate():
    """What discovery sees of a plain door that swings open by 110 degrees; its motion [4, 4] and its corners [8, 3]."""
    plate = (box((0, -0.6, -0.6), (0.12, 0.6, 0.6), PLAIN),)
    obj = shell(SyntheticPart("door", plate, revolute((0, 0, -1.0), (0.12, -0.6, 0), 0, 110)))
    (start, end), _ = both(obj)
    problem, _ = build_problem(start, end, DiscoveryConfig(surfels=4000), 0)
    T = torch.from_numpy(obj.parts[1].pose(1.0) @ np.linalg.inv(obj.parts[1].pose(0.0)))
    corners = torch.from_numpy(np.concatenate([q.corners for q in obj.parts[1].primitives]))
    return problem, [Graph(s.points, s.normals, s.colours) for s in problem.surfels], T, corners


def test_a_flap_turned_over_has_a_hinge_that_no_hinge_would_be():
    problem, graphs, true, corners = swung_plate()
    middle = (corners.amin(0) + corners.amax(0)) / 2
    over = true @ se3.from_screw(torch.tensor([0.0, 0, 1]).double(), middle, torch.tensor(math.pi).double())
    doubts, rest = [], []
    for T in (true, over):
        motions = as_motions(T[None], ["revolute"])
        labelling = label(problem, motions, graphs)
        doubts.append(unlikely_hinges(problem, motions, labelling))
        rest.append(total_score(problem, motions, labelling) - HINGE * doubts[-1])
    assert rest[1] < rest[0] + 0.01  # what surfaces meet does not tell them apart
    assert doubts[0] < 0.1 and doubts[1] > 0.7
    slides = as_motions(torch.eye(4).double()[None], ["prismatic"])
    assert unlikely_hinges(problem, slides, label(problem, slides, graphs)) == 0


def test_a_door_that_turned_out_of_the_light_is_no_contradiction(stacked):
    problem, graphs, _, truth = stacked
    right = label(problem, truth, graphs)
    end, mine = problem.surfels[1], (right.labels(1) == 1)[:, None]
    dark = replace(end, colours=torch.where(mine, 0.4 * end.colours, end.colours))
    shaded = replace(problem, surfels=[problem.surfels[0], dark])
    index = (right.labels(0) == 1).nonzero()[:, 0]
    ways = torch.ones(len(index), dtype=torch.long), problem.surfels[0].normals[index]
    gains = [light_of(p, truth, right).gains(*ways).median() for p in (problem, shaded)]
    assert float(gains[1]) == pytest.approx(0.4 * float(gains[0]), rel=0.02)
    before, lit = (float(violation(p, truth, right, 0, index).mean()) for p in (problem, shaded))
    unlit = float(violation(shaded, truth, right, 0, index, light=TurnedLight(torch.zeros(2, 4))).mean())
    assert abs(lit - before) < 0.02 and unlit > lit + 0.2


def test_what_its_own_plates_other_side_hides_costs_less_than_what_anything_hides():
    problem, graphs, T, corners = swung_plate()
    thin, thick = as_motions(T[None], ["revolute"]), float((corners.amax(0) - corners.amin(0)).min())
    plate = replace(thin, thick=torch.tensor([thick]))
    labelling = label(problem, plate, graphs)
    back = (thin.axis[0].new_tensor([-1.0, 0.0, 0.0]) @ thin.rotate(problem.surfels[1].normals, True)[0].T) > 0.9
    index = (back & (labelling.labels(1) == 1)).nonzero()[:, 0]  # the inside: shut, the front hides it
    assert len(index) > 50
    costs = [violation(problem, m, labelling, 1, index).median() for m in (thin, plate)]
    assert float(costs[0]) == pytest.approx(Landing.HIDDEN) and float(costs[1]) == pytest.approx(Landing.TWO_SIDED)


def test_each_drawer_of_a_row_has_the_amount_that_its_own_front_went():
    travels = (0.30, 0.33, 0.37)
    row = [drawer(y, y + 0.36, -0.3, 0.3, t) for y, t in zip((-0.58, -0.18, 0.22), travels, strict=True)]
    obj = shell(*row)
    (start, end), _ = both(obj, points=8000)
    problem, _ = build_problem(start, end, DiscoveryConfig(surfels=8000), 0)
    T = torch.stack([torch.from_numpy(part.pose(1.0) @ np.linalg.inv(part.pose(0.0))) for part in obj.parts[1:]])
    truth = as_motions(T, ["prismatic"] * 3)
    one = truth[1:2]
    graphs = [Graph(s.points, s.normals, s.colours) for s in problem.surfels]
    found, *single = rows(problem, label(problem, one, graphs), one, truth.axis[:1])
    assert axes_used(found) == 1
    for amount in truth.amount:
        assert float((found.amount - amount).abs().min()) < problem.scale.apart
    assert single and all(len(m) == 1 for m in single)


def test_a_tray_that_seems_turned_is_offered_the_slide_that_its_front_asks_for():
    obj = shell(drawer(-0.5, 0.5, -0.3, 0.3, 0.4))
    (start, end), _ = both(obj, points=6000)
    problem, _ = build_problem(start, end, DiscoveryConfig(surfels=6000), 0)
    T = torch.from_numpy(obj.parts[1].pose(1.0) @ np.linalg.inv(obj.parts[1].pose(0.0)))[None]
    truth = as_motions(T, ["prismatic"])
    turned = Motions(torch.tensor([True]), torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1, 3), torch.tensor([1.57]))
    graphs = [Graph(s.points, s.normals, s.colours) for s in problem.surfels]
    found = Motions.cat(rows(problem, label(problem, turned, graphs), turned, truth.axis))
    assert not bool(found.turn.any()) and float((found.amount - truth.amount).abs().min()) < problem.scale.apart


def test_slides_along_one_direction_share_an_axis_and_turns_do_not():
    z = torch.tensor([[0.0, 0.0, 1.0]]).expand(4, 3).clone()
    z[3] = torch.tensor([0.0, 0.0, -1.0])
    turn = torch.tensor([True, True, False, False])
    motions = Motions(turn, z, torch.zeros(4, 3), torch.ones(4))
    assert axes_used(motions) == 3 and axes_used(motions[2:]) == 1 and axes_used(Motions.empty()) == 0


def test_classify_needs_enough_views_and_a_majority():
    free, on = torch.tensor([3.0, 2.0, 9.0, 0.0, 5.0]), torch.tensor([1.0, 0.0, 8.0, 4.0, 2.0])
    moved, static = classify(free, on)
    assert moved.tolist() == [True, False, False, False, True]
    assert static.tolist() == [False, False, False, True, False]


def random_motions(n=12):
    g = torch.Generator().manual_seed(3)
    axis = torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=1)
    return Motions(torch.arange(n) % 2 == 0, axis, torch.randn(n, 3, generator=g), torch.rand(n, generator=g) + 0.2)


def test_motion_goes_there_and_back_and_is_its_matrix():
    m, p = random_motions(), torch.randn(20, 3)
    there = m.apply(p)
    torch.testing.assert_close(m.apply(there, inverse=True), p.expand_as(there), atol=1e-5, rtol=0)
    for i in range(len(m)):
        T = m.transform(i)
        torch.testing.assert_close(p.double() @ T[:3, :3].T + T[:3, 3], there[i].double(), atol=1e-5, rtol=0)


def test_twist_basis_is_the_derivative_of_displaced():
    m, p, h = random_motions(), torch.randn(30, 3), 1e-3
    basis = m.twist_basis()
    x = m.apply(p)
    for c in range(5):
        step = torch.zeros(len(m), 5)
        step[:, c] = h
        measured = (m.displaced(step).apply(p) - m.displaced(-step).apply(p)) / (2 * h)
        omega, v = basis[:, None, :3, c].expand_as(x), basis[:, None, 3:, c]
        told = torch.linalg.cross(omega, x) + v
        moves = m.turn if c >= 3 else torch.ones_like(m.turn)
        scale = torch.where(m.turn | (torch.tensor(c) == 0), torch.ones(len(m)), torch.ones(len(m)))[:, None, None]
        torch.testing.assert_close((measured * scale)[moves], told[moves], atol=5e-3, rtol=5e-3)


def test_displaced_turns_keep_zero_pitch_and_slides_do_not_turn():
    m = random_motions()
    d = m.displaced(torch.randn(len(m), 5) * 0.3)
    R, t = d.matrices()
    assert float((t * d.axis).sum(1)[d.turn].abs().max()) < 1e-5
    torch.testing.assert_close(R[~d.turn], torch.eye(3).expand_as(R[~d.turn]))


def test_window_planes_recover_a_tilted_plane():
    (start, _), _ = both(shell(drawer(-0.6, 0.6, -0.6, 0.6, 0.3)), views=4, size=80, noise=0.0, points=500)
    stack = DepthStack(start.depths, start.alphas, start.cameras)
    v, y, x = torch.nonzero(stack.valid, as_tuple=True)
    point, normal, support, cosine = window_planes(stack, v, y, x, reach=0.03)
    good = (support > 20) & (cosine > 0.3)
    along = normal[good].abs().max(1).values  # every face of the boxes is axis-aligned
    assert float((along > 0.99).float().mean()) > 0.8
    assert bool((((stack.position[v] - point) * normal).sum(1)[good] > 0).all())


def test_pattern_search_climbs_to_the_top_of_a_known_gain():
    goal = random_motions(2)
    probe = torch.randn(40, 3)

    def gain(m: Motions):
        target = goal.apply(probe).repeat_interleave(len(m) // 2, 0)
        return -(m.apply(probe) - target).pow(2).sum(2).mean(1)

    start = goal.displaced(torch.full((2, 5), 0.15))
    before = gain(start)
    end, value = pattern_search(gain, start, 0.1, rounds=40, turn_radius=1.0)
    assert bool((value > before * 0.02).all()) and bool((value <= 0).all())
    torch.testing.assert_close(gain(end), value)


def test_a_point_pays_where_the_other_state_says_that_what_it_meets_came_from_elsewhere(stacked):
    """Against every pair, one by one."""
    problem, _, _, truth = stacked
    for state in (0, 1):
        landed = arrivals(problem, truth, state)
        theirs = torch.softmax(torch.randn(len(problem.surfels[1 - state]), len(truth) + 1), 1)
        places = truth.places(problem.surfels[state].points, state == 1)
        cost = unlike(landed, [same_place(places, at, problem.scale.apart) for at in places[1:]], theirs)
        for i in range(0, len(cost), 97):
            slow = torch.zeros(len(truth) + 1)
            for k in (k for k in range(len(truth)) if landed[0][k, i] < ELSEWHERE):
                came = [float((p[i] - places[k + 1, i]).norm()) < problem.scale.apart for p in places]
                other = [float(p) for p, here in zip(theirs[landed[1][k, i]], came, strict=True) if not here]
                slow[k + 1] = ELSEWHERE * sum(other)
            torch.testing.assert_close(cost[i], slow, atol=1e-6, rtol=0)


def test_parts_that_went_alike_answer_for_one_another(stacked):
    """A motion given twice: whichever of the two each state calls its surface, nothing contradicts it that did not."""
    problem, graphs, _, truth = stacked
    right, dark = label(problem, truth, graphs), TurnedLight(torch.zeros(3, 4))
    twice = Motions.cat([truth, truth[:1]])
    mine = [(right.labels(s) == 1).nonzero()[:, 0] for s in (0, 1)]
    for state in (0, 1):
        other = torch.nn.functional.pad(right.probability[1 - state], (0, 1))
        other[mine[1 - state]] = torch.eye(4)[3]
        pair = [torch.nn.functional.pad(right.probability[state], (0, 1)), other]
        told = Labelling(pair if state == 0 else pair[::-1], right.cost)
        before = violation(problem, truth, right, state, mine[state], light=dark)
        torch.testing.assert_close(violation(problem, twice, told, state, mine[state], light=dark), before)


def test_what_has_another_colour_in_its_place_has_changed_and_may_have_been_behind():
    """A wall seen by both states, one half of it red in the start."""
    (start, end), _ = both(shell(door(-0.6, 0.6, -0.6, 0.6, True, 50)), views=6, size=60, points=800)
    stack = DepthStack(start.depths, start.alphas, start.cameras)
    problem, _ = build_problem(start, start, DiscoveryConfig(), 0)  # nothing moves: the same state twice
    wall = problem.surfels[0]
    red = wall.points[:, 2] > wall.points[:, 2].median()
    colours = torch.where(red[:, None], torch.tensor([0.9, 0.1, 0.1]), torch.tensor([0.4, 0.4, 0.4]))
    walls = [
        Surfels(wall.points, wall.normals, c, wall.spacing, wall.noise)
        for c in (colours, torch.full_like(colours, 0.4))
    ]
    moved, static, replaced = evidence_masks(walls, [stack, stack], problem.scale.tau, 0.2)
    for s in (0, 1):
        assert torch.equal(moved[s], replaced[s]) and not (moved[s] & static[s]).any()
        assert float(replaced[s][red].float().mean()) > 0.8 and float(replaced[s][~red].float().mean()) < 0.05
    assert not any(m.any() for m in evidence_masks(walls, [stack, stack], problem.scale.tau, 0.7)[2])
    problem.moved, problem.static, problem.replaced = moved, static, replaced
    assert float(unary(problem, Motions.empty(), 0, revealed=True)[replaced[0], 0].max()) == pytest.approx(REVEALED)
    assert float(unary(problem, Motions.empty(), 0)[replaced[0], 0].min()) == 1.0


def test_relabel_by_the_true_motion_labels_like_the_search():
    (start, end), truth = both(shell(door(-0.6, 0.6, -0.6, 0.6, True, 50)), views=12, size=80, points=2500)
    found = discover(start, end, 2, seed=0)
    assert len(found.motions) == 1
    again = relabel(found, torch.stack([m.transform for m in found.motions]), [m.type for m in found.motions])
    for s in (0, 1):
        assert float((again.probability[s].argmax(1) == found.probability[s].argmax(1)).float().mean()) > 0.97
    assert again.motions[0].confidence == pytest.approx(found.motions[0].confidence, abs=0.05)
    nothing = relabel(found, torch.zeros(0, 4, 4).double(), [])  # as when the last part was dropped
    assert nothing.motions == [] and [p.shape[1] for p in nothing.probability] == [1, 1]
    label, _ = nothing.label_points(torch.as_tensor(start.points), torch.as_tensor(start.colours), 0)
    assert not label.any()


def test_a_state_that_shows_nothing_moved_is_looked_at_where_its_fate_is_unknown(stacked):
    problem = stacked[0]
    assert [float(w.sum()) for w in resampled(problem, 0).weights] == pytest.approx([1, 1])
    none = torch.zeros_like(problem.moved[0])
    drawn = resampled(replace(problem, moved=[none, problem.moved[1]]), 0)
    assert len(drawn.samples[0]) and not problem.static[0][drawn.samples[0]].any()
    # each surfel counts alike then: the few of unknown fate do not outweigh the many that moved
    mass = [int((~problem.static[0]).sum()), int(problem.moved[1].sum())]
    mass = [m * float(t[i].mean()) for m, t, i in zip(mass, problem.trust, drawn.samples, strict=True)]
    assert [float(w.sum()) for w in drawn.weights] == pytest.approx([2 * m / sum(mass) for m in mass])


def test_what_arrives_on_surface_of_unknown_fate_need_not_be_answered():
    """Three motions, two points a state. Evidence is even on surfaces of known fate, odd on unknown ones."""
    motions = Motions(torch.zeros(3, dtype=torch.bool), torch.eye(3), torch.zeros(3, 3), torch.ones(3))
    evidence = torch.tensor([[0, 0, 254, 254], [0, 0, 255, 255], [254, 254, 254, 254]], dtype=torch.uint8)
    half = torch.full((2,), 0.5)
    for one_sided, unknown in ((True, 1.0), (False, 0.03)):
        swept = Sweep(motions, evidence, [torch.arange(2)] * 2, one_sided)
        assert swept.gain([half, half]).tolist() == pytest.approx([0.03, unknown, 2 * 254 / 255])
        assert swept.gain([half, half], unknown=True).tolist() == pytest.approx([0.03, 1.0, 2 * 254 / 255])


@pytest.mark.parametrize("k", [1, 3, 9])
def test_nearest_surfels_are_those_of_all_distances(k):
    points, asked = torch.rand(7, 3), torch.rand(5, 3)
    surfels = Surfels(points, points, points, 0.1, 0.0)
    distance, index = surfels.nearest(asked, k)
    expected = torch.cdist(asked.double(), points.double()).topk(min(k, 7), largest=False)
    assert torch.equal(index, expected.indices) and torch.allclose(distance, expected.values, atol=1e-6)
