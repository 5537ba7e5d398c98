"""Joint errors against ground truth: axis angle, axis position, motion; parts matched by assignment.

The protocol of ArtGS (which the paper's tables follow) with its faults removed: arccos is clipped, every ground-truth
joint is reported on its own, and the mean axis position is given with and without the zeros that prismatic joints
contribute.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Mapping, Protocol, Sequence

import numpy as np

TYPE_MISMATCH = 1e6
PARALLEL = 1e-6


class JointLike(Protocol):
    """What is read of a joint: ``p2gs.types.Joint`` has it, ground-truth readers give it.

    axis, origin: 3 numbers (tensor, array, list).  motion: signed start -> end about ``axis``, degrees (revolute) or
    length.
    """

    type: str
    axis: object
    origin: object
    motion: float


@dataclass(frozen=True)
class JointErrors:
    """One pair: axis_angle [degrees, 0..90], axis_position [x10 scene units; None for prismatic], motion [degrees or
    scene units]."""

    axis_angle: float
    axis_position: float | None
    motion: float

    @property
    def cost(self) -> float:
        """The matching cost of the protocol: degrees + 10 x distance of the axes + motion, that is the sum of what is
        reported."""
        return self.axis_angle + (self.axis_position or 0.0) + self.motion


@dataclass(frozen=True)
class JointScore:
    """One ground-truth joint. ``pred`` indexes the predictions, None where nothing was left to match. Failed ('F'):
    errors is None."""

    gt: int
    type: str
    pred: int | None
    pred_type: str | None
    errors: JointErrors | None

    @property
    def failed(self) -> bool:
        return self.errors is None


@dataclass(frozen=True)
class JointReport:
    """All joints of one object. Means run over the joints that did not fail and are None where there are none.

    pos_mean_artgs counts a prismatic joint as position 0 (as the published tables do); pos_mean_revolute leaves it out.
    motion_mean mixes degrees and lengths for mixed objects, as the tables do; the two below it do not.
    extra: indices of predictions that no ground-truth joint was matched to.
    """

    joints: list[JointScore]
    extra: list[int] = field(default_factory=list)
    failures: int = 0
    axis_angle_mean: float | None = None
    pos_mean_artgs: float | None = None
    pos_mean_revolute: float | None = None
    motion_mean: float | None = None
    motion_mean_revolute: float | None = None
    motion_mean_prismatic: float | None = None

    @property
    def assignment(self) -> dict[int, int]:
        """gt index -> pred index of what was matched, rightly typed or not (for ``evaluate_chamfer``)."""
        return {s.gt: s.pred for s in self.joints if s.pred is not None}

    def to_dict(self) -> dict:
        """Plain numbers, for JSON."""
        return asdict(self)


def _vector(x) -> np.ndarray:
    return np.asarray(x.detach().cpu() if hasattr(x, "detach") else x, dtype=np.float64).reshape(3)


def _unit(x) -> np.ndarray:
    v = _vector(x)
    length = np.linalg.norm(v)
    if not length > 0:
        raise ValueError("a joint axis has length zero")
    return v / length


def axis_angle_error(axis_a, axis_b) -> float:
    """Angle between two lines in degrees, [0, 90]: the sign of an axis is a convention, not an error.

    By atan2(|a x b|, |a . b|), equal to arccos of the clipped |a . b| and exact for small angles too.

    >>> axis_angle_error([0, 0, 1], [0, 0, -2])
    0.0
    """
    a, b = _unit(axis_a), _unit(axis_b)
    return math.degrees(math.atan2(np.linalg.norm(np.cross(a, b)), abs(a @ b)))


def line_distance(axis_a, origin_a, axis_b, origin_b) -> float:
    """Distance between two lines, in scene units; between a point of b and line a where the axes are parallel.

    >>> line_distance([0, 0, 1], [0, 0, 0], [1, 0, 0], [0, 3, 9])
    3.0
    """
    a, b = _unit(axis_a), _unit(axis_b)
    between = _vector(origin_b) - _vector(origin_a)
    n = np.cross(a, b)
    length = np.linalg.norm(n)
    if length < PARALLEL:
        return float(np.linalg.norm(np.cross(between, a)))
    return float(abs(n @ between) / length)


def _turn(axis: np.ndarray, degrees: float) -> np.ndarray:
    half = math.radians(degrees) / 2
    return np.append(axis * math.sin(half), math.cos(half))


def motion_error(pred: JointLike, gt: JointLike) -> float:
    """How far the start -> end motions are apart: geodesic degrees between the rotations, or length between the
    translations.

    Both are taken from axis and signed motion, so flipping both signs changes nothing. The types must agree
    (ValueError).
    """
    if pred.type != gt.type:
        raise ValueError(f"motion error between a {pred.type} and a {gt.type} joint is undefined")
    p, g = _unit(pred.axis), _unit(gt.axis)
    if gt.type == "prismatic":
        return float(np.linalg.norm(p * float(pred.motion) - g * float(gt.motion)))
    qp, qg = _turn(p, pred.motion), _turn(g, gt.motion)
    # angle between unit quaternions a, b without arccos: 4 atan2(|a - b|, |a + b|), q and -q being one rotation
    minus, plus = np.linalg.norm(qp - qg), np.linalg.norm(qp + qg)
    return math.degrees(4 * math.atan2(min(minus, plus), max(minus, plus)))


def joint_errors(pred: JointLike, gt: JointLike) -> JointErrors:
    """The three errors of one matched pair of equal type (ValueError otherwise)."""
    position = None
    if gt.type == "revolute":
        position = 10 * line_distance(gt.axis, gt.origin, pred.axis, pred.origin)
    return JointErrors(axis_angle_error(pred.axis, gt.axis), position, motion_error(pred, gt))


def match_joints(pred: Sequence[JointLike], gt: Sequence[JointLike]) -> dict[int, int]:
    """gt index -> pred index, minimising the summed cost (wrong type: 1e6). Surplus joints of either side stay
    unmatched."""
    from scipy.optimize import linear_sum_assignment

    cost = np.full((len(gt), len(pred)), TYPE_MISMATCH)
    for i, g in enumerate(gt):
        for j, p in enumerate(pred):
            if p.type == g.type:
                cost[i, j] = joint_errors(p, g).cost
    return {int(g): int(p) for g, p in zip(*linear_sum_assignment(cost), strict=True)}


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None


def evaluate_joints(
    pred: Sequence[JointLike], gt: Sequence[JointLike], assignment: Mapping[int, int] | None = None
) -> JointReport:
    """Errors of every ground-truth joint of one object.

    pred: the twin's joints, any number and order.  gt: the true ones, in the same coordinates and units.  assignment:
    gt index -> pred index when the parts were matched by other evidence (their meshes), otherwise by ``match_joints``.
    A ground-truth joint without a partner, or with one of the wrong type, has failed and is counted.

    >>> from types import SimpleNamespace as J
    >>> door = J(type="revolute", axis=[0, 0, 1], origin=[1, 0, 0], motion=60.0)
    >>> found = J(type="revolute", axis=[0, 0, -1], origin=[1, 0.01, 5], motion=-59.0)
    >>> report = evaluate_joints([found], [door])
    >>> round(report.pos_mean_revolute, 6), round(report.motion_mean, 6), report.failures
    (0.1, 1.0, 0)
    """
    assignment = match_joints(pred, gt) if assignment is None else assignment
    scores = []
    for i, g in enumerate(gt):
        j = assignment.get(i)
        found = None if j is None else pred[j]
        errors = joint_errors(found, g) if found is not None and found.type == g.type else None
        scores.append(JointScore(i, g.type, j, None if found is None else found.type, errors))
    good = [(s.type, s.errors) for s in scores if s.errors is not None]
    return JointReport(
        joints=scores,
        extra=sorted(set(range(len(pred))) - set(assignment.values())),
        failures=sum(s.failed for s in scores),
        axis_angle_mean=_mean([e.axis_angle for _, e in good]),
        pos_mean_artgs=_mean([e.axis_position or 0.0 for _, e in good]),
        pos_mean_revolute=_mean([e.axis_position for kind, e in good if kind == "revolute"]),
        motion_mean=_mean([e.motion for _, e in good]),
        motion_mean_revolute=_mean([e.motion for kind, e in good if kind == "revolute"]),
        motion_mean_prismatic=_mean([e.motion for kind, e in good if kind == "prismatic"]),
    )
