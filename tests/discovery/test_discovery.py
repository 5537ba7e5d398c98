"""Whole discovery on small scenes of boxes: the right parts, types and motions, and none where nothing moves."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from boxes import PLAIN, both, box, door, drawer, shell

from p2gs.data.generated.articulated import SyntheticObject, SyntheticPart, prismatic, revolute
from p2gs.motion.discovery import (
    DiscoveryConfig,
    StateEvidence,
    as_motions,
    discover,
    instead_of,
    left_over,
    places_changed,
)
from p2gs.motion.discovery.leftover import as_turns
from p2gs.ops import se3
from p2gs.types import UserError

SMALL = DiscoveryConfig(surfels=4000, samples=250, candidates=2)


def joint_errors(motion, joint, transform):
    """(axis degrees, axis position, motion in degrees or length) of a found motion of the right type."""
    T, G = motion.transform.numpy(), transform
    axis = np.degrees(np.arccos(min(1.0, abs(float(motion.axis.numpy() @ joint.axis)))))
    if joint.type == "prismatic":
        return axis, 0.0, float(np.linalg.norm(T[:3, 3] - G[:3, 3]))
    off = motion.origin.numpy() - joint.origin
    cross = np.cross(motion.axis.numpy(), joint.axis)
    n = np.linalg.norm(cross)
    position = np.linalg.norm(np.cross(off, joint.axis)) if n < 1e-3 else abs(off @ cross) / n
    turn = np.degrees(np.arccos(np.clip((np.trace(T[:3, :3].T @ G[:3, :3]) - 1) / 2, -1, 1)))
    return axis, position, turn


def match(found, obj):
    """Index of the found motion of each moving part; fails where one is missing."""
    order = []
    for part in obj.parts[1:]:
        G = part.pose(1.0) @ np.linalg.inv(part.pose(0.0))
        right = [
            k
            for k, m in enumerate(found.motions)
            if m.type == part.joint.type
            and np.abs(m.transform.numpy() - G).max() < (0.15 if m.type == "revolute" else 0.05)
        ]
        assert right, (
            f"{part.joint.type} {part.joint.motion:.2f} is missing among "
            f"{[(m.type, round(m.amount, 2)) for m in found.motions]}"
        )
        axis, position, amount = joint_errors(found.motions[right[0]], part.joint, G)
        assert axis < 2 and position < 0.03, (axis, position)
        assert amount < (3 if part.joint.type == "revolute" else 0.03)
        order.append(right[0])
    return order


def label_accuracy(found, order, truth):
    part_of = torch.zeros(len(found.motions) + 1, dtype=torch.long)
    for part, k in enumerate(order):
        part_of[k + 1] = part + 1
    return [
        float((part_of[lab] == t).float().mean())
        for lab, t in zip((found.labels_start, found.labels_end), truth, strict=True)
    ]


@pytest.fixture(scope="module")
def door_and_drawer():
    obj = shell(
        door(-0.6, 0.6, 0.0, 0.6, True, 60),
        drawer(-0.6, 0.6, -0.6, 0.0, 0.35),
        static=[box((-0.7, -0.6, -0.02), (0, 0.6, 0.02), PLAIN)],
    )
    views, truth = both(obj)
    return obj, views, truth, discover(*views, "auto", SMALL, seed=0)


def test_door_and_drawer(door_and_drawer):
    obj, _, truth, found = door_and_drawer
    assert len(found.motions) == 2
    assert min(label_accuracy(found, match(found, obj), truth)) > 0.9
    assert all(0 < m.confidence <= 1 for m in found.motions) and sum(m.mass for m in found.motions) > 0.8


def test_a_wrong_motion_amid_right_ones_is_asked_for_anew(door_and_drawer):
    obj, _, _, found = door_and_drawer
    door_k, drawer_k = match(found, obj)
    truth = torch.as_tensor(obj.parts[2].pose(1.0) @ np.linalg.inv(obj.parts[2].pose(0.0)))
    T, types = torch.stack([m.transform for m in found.motions]), [m.type for m in found.motions]
    T[drawer_k], types[drawer_k] = T[door_k] @ T[door_k], "revolute"
    proposed = instead_of(found, T, types, drawer_k)
    assert {kind for _, kind in proposed} == {"revolute", "prismatic"} and len(proposed) <= 4
    # before it is refined
    assert min(float((A[:3, 3] - truth[:3, 3]).norm()) for A, kind in proposed if kind == "prismatic") < 0.1
    # so it is when the part is missing
    more = instead_of(found, T[[door_k]], ["revolute"], None)
    assert min(float((A[:3, 3] - truth[:3, 3]).norm()) for A, kind in more if kind == "prismatic") < 0.1
    # the part's own motion is no other motion
    T[drawer_k], types[drawer_k] = truth, "prismatic"
    assert all(float((A - truth).abs().max()) > 0.03 for A, _ in instead_of(found, T, types, drawer_k))


def test_a_small_part_amid_a_large_one_is_found_by_itself():
    """A latch of a twentieth of the moved surface, with the door's motion known; nothing where all is explained."""
    latch = SyntheticPart(
        "latch",
        (box((-0.5, 0.6, 0.1), (-0.2, 0.66, 0.4), PLAIN), box((-0.5, 0.66, 0.1), (-0.4, 0.75, 0.4), PLAIN)),
        revolute((0, 0, 1.0), (-0.5, 0.6, 0.26), 0, 40),
    )
    obj = shell(door(-0.6, 0.6, -0.6, 0.6, True, 60), latch)
    views, _ = both(obj, size=200)
    found = discover(*views, 2, SMALL, seed=0)
    true = [torch.as_tensor(p.pose(1.0) @ np.linalg.inv(p.pose(0.0))) for p in obj.parts[1:]]
    proposed = left_over(found, true[0][None], ["revolute"])
    points = torch.from_numpy(np.stack([q.pose[:3, 3] for q in obj.parts[2].primitives]))
    gaps = [float((se3.apply(T, points) - se3.apply(true[1], points)).norm(dim=1).mean()) for T, _ in proposed]
    assert min(gaps) < 0.02
    assert left_over(found, torch.stack(true), ["revolute"] * 2) == []


def test_turns_take_a_slides_middle_to_the_same_place(door_and_drawer):
    *_, found = door_and_drawer
    problem = found.problem
    drawer = next(i for i, m in enumerate(found.motions) if m.type == "prismatic")
    slide = as_motions(found.motions[drawer].transform[None], ["prismatic"])
    turns = as_turns(problem, slide, torch.eye(3))
    pay = problem.pay(slide)[0][0][0]
    middle = (problem.surfels[0].points[problem.samples[0]] * pay[:, None]).sum(0) / pay.sum()
    across = slide.axis - turns.axis * (turns.axis @ slide.axis[0])[:, None]
    assert turns.turn.all() and len(turns) > 60
    gone = turns.apply(middle[None])[:, 0] - middle
    assert torch.allclose(gone, across * slide.amount, atol=1e-4)


def test_two_like_parts_taken_for_one_another_change_back():
    """Two cubes, each said to have gone where the other is: no surfel is left over, and no change of one motion alone
    mends it."""

    def cube(x, y, travel):
        return SyntheticPart(
            "cube", (box((x, y, 0), (x + 0.3, y + 0.3, 0.3), PLAIN),), prismatic((1, 0, 0), (0, 0, 0), 0, travel)
        )

    floor = SyntheticPart("base", (box((-0.7, -0.6, -0.1), (0.7, 0.6, 0), PLAIN),))
    obj = SyntheticObject("cubes", (floor, cube(-0.6, -0.5, 0.5), cube(-0.5, 0.2, 0.7))).fitted()
    found = discover(*both(obj)[0], "auto", SMALL, seed=0)
    truth = torch.stack([torch.as_tensor(p.pose(1.0) @ np.linalg.inv(p.pose(0.0))) for p in obj.parts[1:]])
    # from the first cube to the second, fitted
    between = torch.tensor([0.1, 0.7, 0.0]).double() * float(truth[0, :3, 3].norm() / 0.5)
    wrong = truth.clone()
    wrong[0, :3, 3] = between + truth[1, :3, 3]
    wrong[1, :3, 3] = truth[0, :3, 3] - between
    proposed = places_changed(found, wrong, ["prismatic"] * 2)
    off = [
        max(float((T[k] - truth[k])[:3, 3].norm()) for k in (0, 1))
        for _, T, types in proposed
        if types == ["prismatic"] * 2
    ]
    assert min(off) < 0.05


def test_label_points_agrees_with_labels_and_is_unsure_far_away(door_and_drawer):
    _, views, _, found = door_and_drawer
    for state, (view, labels) in enumerate(zip(views, (found.labels_start, found.labels_end), strict=True)):
        again, margin = found.label_points(view.points, view.colours, state)
        assert torch.equal(again, labels)
        assert 0 <= float(margin.min()) and float(margin.max()) <= 1
    surfels = found.surfels[1]
    own, _ = found.label_points(surfels.points, surfels.colours, 1)
    assert float((own == found.probability[1].argmax(1)).float().mean()) > 0.98
    _, lost = found.label_points(torch.tensor([[5.0, 5.0, 5.0]]), None, 1)
    assert float(lost) < 1e-3


def test_result_is_the_same_twice_with_any_number_of_threads(door_and_drawer, threads):
    _, views, _, found = door_and_drawer
    again = discover(*views, "auto", SMALL, seed=0)
    assert [m.transform.tolist() for m in again.motions] == [m.transform.tolist() for m in found.motions]
    assert torch.equal(again.labels_end, found.labels_end)


def test_every_candidate_is_complete(door_and_drawer):
    _, views, _, found = door_and_drawer
    assert found.candidates and found.candidates[0].motions == found.motions
    scores = [c.score for c in found.candidates]
    assert scores[0] == min(scores) == found.score
    for c in found.candidates:
        assert int(c.labels_start.max()) <= len(c.motions) and len(c.labels_end) == len(views[1].points)
    assert {"tau", "noise", "states", "axes", "search", "seconds", "candidates"} <= set(found.diagnostics)
    assert len(found.diagnostics["search"]) == SMALL.searches and all(
        s["motions_tried"] > 0 for s in found.diagnostics["search"]
    )


def test_double_doors_are_not_swapped():
    obj = shell(door(-0.6, -0.005, -0.6, 0.6, True, 65), door(0.005, 0.6, -0.6, 0.6, False, 65))
    views, truth = both(obj, seed=1)
    found = discover(*views, 3, SMALL, seed=0)
    assert len(found.motions) == 2
    assert min(label_accuracy(found, match(found, obj), truth)) > 0.9


def test_two_drawers_of_different_travel():
    divider = [box((-0.7, -0.6, -0.02), (0, 0.6, 0.02), PLAIN)]
    obj = shell(drawer(-0.6, 0.6, 0.0, 0.6, 0.3), drawer(-0.6, 0.6, -0.6, 0.0, 0.45), static=divider)
    views, _ = both(obj, seed=2)
    found = discover(*views, "auto", SMALL, seed=0)
    assert len(found.motions) == 2
    match(found, obj)


def test_nothing_moves():
    obj = shell(static=[box((0, -0.6, -0.6), (0.04, 0.6, 0.0), PLAIN)])
    (start, _), _ = both(obj, seed=3)
    (end, _), _ = both(obj, seed=4)
    found = discover(start, end, "auto", SMALL, seed=0)
    assert found.motions == [] and int(found.labels_start.max()) == 0 and len(found.labels_end) == len(end.points)
    none = discover(start, end, 1, SMALL, seed=0)
    assert none.motions == []


def test_revealed_inside_is_not_a_part(door_and_drawer):
    """What the opened door shows of the cupboard's inside stays static, and is unknown rather than moved to the
    evidence."""
    _, views, truth, found = door_and_drawer
    inside = (truth[1] == 0) & (views[1].points[:, 0] < -0.3) & (found.evidence_end != 0)
    assert int(inside.sum()) > 20
    assert float((found.evidence_end[inside] == -1).float().mean()) > 0.9
    assert float((found.labels_end[inside] == 0).float().mean()) > 0.9


@pytest.mark.parametrize("bad", [0, -2, 2.5, "three"])
def test_bad_number_of_parts_is_a_users_mistake(bad, door_and_drawer):
    with pytest.raises(UserError, match="num_parts"):
        discover(*door_and_drawer[1], bad, SMALL)


def test_map_of_another_size_than_its_camera_is_refused(door_and_drawer):
    start, end = door_and_drawer[1]
    short = [start.depths[0][:50], *start.depths[1:]]
    broken = StateEvidence(start.points, start.colours, None, start.weights, short, start.alphas, start.cameras)
    with pytest.raises(ValueError, match="camera's size"):
        discover(broken, end, 2, SMALL)
