"""A joint's confidence falls with its error, with lost support and with two directions that disagree; it needs no
ground truth."""

import math
from dataclasses import replace

import pytest
import torch
from tiny import hinge, photographs, slide, textured_panels

from p2gs.data.views import TrainingViews
from p2gs.gaussians.handover import StateGaussians
from p2gs.motion.joint_confidence import JointEvidence, landing, measure_joints, measuring_level, nudges, state_depth
from p2gs.motion.screw_polish import MovedGaussians
from p2gs.ops import se3, so3
from p2gs.types import GaussianTensors

SIZE = 64


def world(transform):
    """Two states of the panels that are exactly right, their photographs and rendered depth."""
    g, labels = textured_panels(1600)
    g.log_scales.fill_(-3.5)
    means, quats, sh = MovedGaussians(g, labels).moved(transform[None])
    states = [
        StateGaussians(0, g),
        StateGaussians(1, GaussianTensors(means, quats, g.log_scales, g.opacity_logits, sh)),
    ]
    views = {
        s: TrainingViews(photographs(g, labels, T, s, SIZE), [SIZE])
        for s, T in ((0, torch.eye(4).double()), (1, transform))
    }
    return states, labels, views


def evidence(states, labels, views, T, kind, both=None) -> JointEvidence:
    stacks = [state_depth(state, views[s], SIZE) for s, state in enumerate(states)]
    (found,) = measure_joints(states, [labels, labels], T[None], [kind], views, stacks, level=SIZE, both=both)
    return found


def turned(T, degrees, tilt=False):
    """A hinge's motion with ``degrees`` more, or with its axis tilted by them."""
    s = se3.screw_parameters(T)
    axis = s.axis
    if tilt:
        across = torch.linalg.cross(axis, torch.tensor([0.0, 1, 0]).double())
        axis = so3.rotvec_to_matrix(across / across.norm() * degrees / 57.29578) @ axis
    return se3.from_screw(axis, s.origin, s.angle + (0.0 if tilt else degrees / 57.29578))


@pytest.fixture(scope="module")
def door():
    return world(hinge())


def test_without_a_static_part_there_is_nothing_that_a_part_looks_worse_than(door):
    """All is the door's, so that it is right where the door was and wrong elsewhere."""
    states, labels, views = door
    with_static = evidence(states, labels, views, hinge(), "revolute")
    alone = evidence(states, torch.ones_like(labels), views, hinge(), "revolute")
    assert math.isfinite(with_static.residual) and math.isnan(alone.residual) and math.isfinite(alone.confidence)


@pytest.mark.parametrize("tilt", [False, True])
def test_confidence_of_a_hinge_falls_with_its_error(door, tilt):
    found = [evidence(*door, turned(hinge(), d, tilt), "revolute") for d in (0.0, 1.0, 2.5, 5.0, 10.0)]
    values = [e.confidence for e in found]
    assert values[0] > 0.9 and max(values[3:]) < 0.6, values  # without two directions to compare
    assert values == sorted(values, reverse=True), values
    assert found[0].fall < 0.02 < found[3].fall


def test_confidence_of_a_slide_falls_with_its_error():
    states, labels, views = world(slide())
    values = []
    for miss in (0.0, 0.02, 0.05, 0.1):
        T = slide()
        T[0, 3] += miss
        values.append(evidence(states, labels, views, T, "prismatic").confidence)
    assert values[0] > 0.9 and values[1] < 0.6 and values == sorted(values, reverse=True), values


def test_half_the_support_removed(door):
    """Where the other state shows only half of the part, half of it lands in free space."""
    states, labels, views = door
    moved = (labels == 1) & (states[0].gaussians.means[:, 2] > 0)
    rest = StateGaussians(1, states[1].gaussians[~moved])
    g, kept = states[0].gaussians[~moved], labels[~moved]
    half = {0: views[0], 1: TrainingViews(photographs(g, kept, hinge(), 1, SIZE), [SIZE])}
    stacks = [state_depth(s, half[i], SIZE) for i, s in enumerate((states[0], rest))]
    (found,) = measure_joints([states[0], rest], [labels, kept], hinge()[None], ["revolute"], half, stacks, level=SIZE)
    whole = evidence(*door, hinge(), "revolute")
    assert 0.3 < found.contradicted < 0.7 and whole.contradicted < 0.05
    assert found.confidence < whole.confidence - 0.1


def test_directions_that_disagree(door):
    values = []
    for degrees in (0.0, 1.0, 3.0):
        both = [hinge()[None], turned(hinge(), degrees)[None]]
        values.append(evidence(*door, hinge(), "revolute", both).confidence)
    assert values[0] > values[1] > values[2], values


def test_landing_tells_surface_from_free_space(door):
    states, labels, views = door
    stack = state_depth(states[1], views[1], SIZE)
    (right,) = landing(states[0], labels, hinge()[None], stack)
    (stayed,) = landing(states[0], labels, torch.eye(4).double()[None], stack)
    assert right[0] > 0.6 and right[1] < 0.05  # the rest is inside the panel, behind its face
    assert stayed[1] > 0.3
    assert landing(states[0], torch.zeros_like(labels), hinge()[None], stack) == [(0.0, 0.0)]


def test_nudges_keep_the_joint_type_and_the_size():
    centre = torch.tensor([0.0, 0.5, 0.0]).double()
    for kind, T, count in (("revolute", hinge(), 5), ("prismatic", slide(), 3)):
        pairs = nudges(kind, T, centre, 0.3, 0.02)
        assert len(pairs) == count
        for forth, back in pairs:
            for changed in (forth, back):
                s = se3.screw_parameters(changed)
                assert float(s.translation.abs() if kind == "revolute" else so3.rotation_angle(changed[:3, :3])) < 1e-6
                assert 0 < float((changed - T).abs().max()) < 0.2


def test_a_part_that_no_photograph_shows_has_no_confidence(door):
    states, labels, views = door
    far = torch.eye(4).double()
    far[2, 3] = 50.0
    found = evidence(states, labels, views, far, "prismatic")
    assert found.views == 0 and found.confidence == 0.0


def test_confidence_is_a_probability_that_falls_with_each_measure():
    clean = JointEvidence(coverage=0.9, contradicted=0.0, residual=1.0, rise=0.1, fall=0.0, disagreement=0.001, views=4)
    assert 0.9 < clean.confidence < 1
    for name, values in {
        "contradicted": (0.2, 0.6),
        "rise": (0.03, 0.01),
        "fall": (0.05, 0.09),
        "disagreement": (0.01, 0.05),
    }.items():
        found = [clean.confidence, *(replace(clean, **{name: v}).confidence for v in values)]
        assert found == sorted(found, reverse=True) and len(set(found)) == 3, name
    worst = replace(clean, contradicted=0.5, rise=0.0, fall=0.1, disagreement=0.05)
    assert worst.confidence < 0.1 and replace(clean, views=0).confidence == 0


def test_that_neither_direction_pulled_is_no_agreement():
    told = JointEvidence(coverage=0.9, contradicted=0.0, residual=1.0, rise=0.1, fall=0.0, disagreement=1e-6, views=4)
    silent, unasked = replace(told, disagreement=0.0), replace(told, disagreement=None)
    assert silent.confidence == unasked.confidence < told.confidence


def test_size_of_the_photographs_that_joints_are_measured_in():
    assert measuring_level(TrainingViews([], [100, 400])) == 100 and measuring_level(TrainingViews([], [300])) == 300
