import doctest
import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from p2gs.metrics import joints as J
from p2gs.types import Joint


def joint(kind, axis, origin=(0, 0, 0), motion=60.0):
    return SimpleNamespace(type=kind, axis=axis, origin=origin, motion=motion)


def random_joint(rng):
    kind = rng.choice(["revolute", "prismatic"])
    motion = rng.uniform(-170, 170) if kind == "revolute" else rng.uniform(-1, 1)
    return joint(str(kind), rng.normal(size=3), rng.normal(size=3), float(motion))


def test_docstrings_run():
    assert doctest.testmod(J).failed == 0
    assert doctest.testmod(J).attempted >= 6


def test_axis_angle_is_sign_free_and_never_nan():
    rng = np.random.default_rng(0)
    for _ in range(300):
        a = rng.normal(size=3).astype(np.float32)
        assert J.axis_angle_error(a, a) < 1e-5  # unclipped arccos gives NaN for a third of these
        a, b = a.astype(float), rng.normal(size=3)
        expected = math.degrees(math.acos(abs(a @ b) / np.linalg.norm(a) / np.linalg.norm(b)))
        assert J.axis_angle_error(a, b) == pytest.approx(expected, abs=1e-5)
        assert J.axis_angle_error(-a, b) == pytest.approx(expected, abs=1e-5)
    with pytest.raises(ValueError, match="length zero"):
        J.axis_angle_error([0, 0, 0], [0, 0, 1])


def test_line_distance_against_minimisation_and_parallel_lines():
    rng = np.random.default_rng(1)
    for _ in range(50):
        a, b, p, q = rng.normal(size=(4, 3))
        # closest points of two lines: least squares in the two parameters
        _, residual, *_ = np.linalg.lstsq(np.stack([a, -b], 1), q - p, rcond=None)
        assert J.line_distance(a, p, b, q) == pytest.approx(math.sqrt(residual[0]), abs=1e-9)
    assert J.line_distance([0, 0, 1], [0, 0, 0], [0, 0, -3], [3, 4, 7]) == pytest.approx(5)


def test_motion_error_against_scipy():
    rng = np.random.default_rng(2)
    for _ in range(100):
        a, b = rng.normal(size=(2, 3))
        s, t = rng.uniform(-300, 300, 2)
        ra, rb = (Rotation.from_rotvec(math.radians(m) * v / np.linalg.norm(v)) for m, v in ((s, a), (t, b)))
        error = J.motion_error(joint("revolute", a, motion=s), joint("revolute", b, motion=t))
        assert error == pytest.approx(math.degrees((ra.inv() * rb).magnitude()), abs=1e-6)
    error = J.motion_error(joint("prismatic", [2, 0, 0], motion=0.3), joint("prismatic", [0, 1, 0], motion=-0.4))
    assert error == pytest.approx(0.5)
    with pytest.raises(ValueError, match="undefined"):
        J.motion_error(joint("prismatic", [1, 0, 0]), joint("revolute", [1, 0, 0]))


def test_flipping_axis_and_motion_together_changes_nothing():
    rng = np.random.default_rng(3)
    for _ in range(20):
        p = random_joint(rng)
        flipped = joint(p.type, -p.axis, p.origin, -p.motion)
        errors = J.joint_errors(flipped, p)
        assert errors.axis_angle < 1e-6
        assert errors.motion < 1e-6
        assert (errors.axis_position is None) == (p.type == "prismatic")
        wrong_way = joint(p.type, p.axis, p.origin, -p.motion)
        assert J.joint_errors(wrong_way, p).motion > 1e-3


def test_position_is_scaled_by_ten_and_absent_for_prismatic():
    assert J.joint_errors(
        joint("revolute", [0, 0, 1], [0.02, 0, 9]), joint("revolute", [0, 0, 1])
    ).axis_position == pytest.approx(0.2)
    assert (
        J.joint_errors(joint("prismatic", [0, 0, 1], [0.02, 0, 9]), joint("prismatic", [0, 0, 1])).axis_position is None
    )


def best_permutation_cost(pred, gt):
    """All permutations, as the ancestors do it."""
    cost = lambda p, g: J.joint_errors(p, g).cost if p.type == g.type else 1e6  # noqa: E731
    return min(sum(cost(p, g) for p, g in zip(order, gt, strict=True)) for order in itertools.permutations(pred))


def test_matching_is_the_best_permutation():
    rng = np.random.default_rng(4)
    for _ in range(10):
        pred, gt = [random_joint(rng) for _ in range(4)], [random_joint(rng) for _ in range(4)]
        pairs = J.match_joints(pred, gt)
        cost = sum(J.joint_errors(pred[p], gt[g]).cost if pred[p].type == gt[g].type else 1e6 for g, p in pairs.items())
        assert cost == pytest.approx(best_permutation_cost(pred, gt))


def test_failures_extras_and_means():
    door, drawer = joint("revolute", [0, 0, 1], motion=60), joint("prismatic", [1, 0, 0], motion=0.3)
    shifted = joint("revolute", [0, 0, 1], [0.01, 0, 0], 58)
    report = J.evaluate_joints([joint("revolute", [0, 1, 0]), drawer, shifted], [door, drawer])
    assert (report.failures, report.extra) == (0, [0])
    assert [s.pred for s in report.joints] == [2, 1]
    assert report.pos_mean_artgs == pytest.approx(0.05)
    assert report.pos_mean_revolute == pytest.approx(0.1)
    assert report.motion_mean_revolute == pytest.approx(2)
    assert report.motion_mean_prismatic == pytest.approx(0, abs=1e-12)

    wrong = J.evaluate_joints([joint("revolute", [1, 0, 0]), door], [door, drawer])
    assert wrong.failures == 1
    assert wrong.joints[1].failed
    assert wrong.joints[1].pred_type == "revolute"
    assert wrong.axis_angle_mean == pytest.approx(0)

    missing = J.evaluate_joints([], [door, drawer])
    assert (missing.failures, missing.axis_angle_mean, missing.pos_mean_artgs) == (2, None, None)
    assert J.evaluate_joints([door], []).extra == [0]
    given = J.evaluate_joints([shifted, door], [door], assignment={0: 0})
    assert given.joints[0].pred == 0
    assert given.extra == [1]


def test_takes_the_twins_own_joints_and_gives_plain_numbers():
    import json

    mine = Joint("revolute", torch.tensor([0.0, 0.0, 1.0]), torch.zeros(3), 30.0, (0.0, 30.0), torch.eye(4))
    report = J.evaluate_joints([mine], [joint("revolute", [0, 0, 1], motion=30)])
    assert json.loads(json.dumps(report.to_dict()))["joints"][0]["errors"]["motion"] == pytest.approx(0, abs=1e-6)
