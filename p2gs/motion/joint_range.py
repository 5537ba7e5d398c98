"""How far a joint can go on beyond the two photographed states: until its part runs into another one.

The parts are surface points (the twin's solid Gaussians). A point runs into a surface when it passes one of its points,
within about a point spacing sideways, and that surface faces the motion; a wall that the part slides along does not
stop it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from p2gs.ops import se3
from p2gs.types import ArticulatedObject, Joint, Part

FULL_TURN = 180.0  # degrees beyond which no hinge is followed
TOUCHING = 0.015  # share of a part's points that have run into something when the joint is said to stop
FACING = 0.5  # |cos| between an obstacle's normal and the motion from which it stands in the way
POINTS = 1500  # of the moving part that are followed


@dataclass
class Obstacles:
    """Points [N, 3] of the other parts with unit normals [N, 3] and their spacing."""

    points: np.ndarray
    normals: np.ndarray
    spacing: float

    @staticmethod
    def of(points: np.ndarray, neighbours: int = 12) -> "Obstacles":
        """Normals by principal axes of the nearest neighbours; lone points (three times the usual distance from their
        neighbours) go."""
        k = min(neighbours, len(points) - 1)
        if k < 3:
            return Obstacles(np.zeros((0, 3)), np.zeros((0, 3)), 1.0)
        distance, index = cKDTree(points).query(points, k=k + 1)
        near = points[index] - points[index].mean(1, keepdims=True)
        normals = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1][:, :, 0]
        mean = distance[:, 1:].mean(1)
        keep = mean < 3 * np.median(mean)
        return Obstacles(points[keep], normals[keep], float(np.median(distance[:, min(4, k)])))

    def __getitem__(self, keep) -> "Obstacles":
        return Obstacles(self.points[keep], self.normals[keep], self.spacing)


def passed(before: np.ndarray, after: np.ndarray, obstacles: Obstacles, sideways: float) -> np.ndarray:
    """Pairs (moving point, obstacle) [M, 2] of a step ``before`` -> ``after`` [P, 3]: the obstacle faces the step and
    lies along it, at most ``sideways`` beside it."""
    if not len(obstacles.points):
        return np.zeros((0, 2), dtype=np.int64)
    step = after - before
    length = np.linalg.norm(step, axis=1)
    u = step / np.maximum(length, 1e-12)[:, None]
    reach = float(np.hypot(length.max(initial=0.0) / 2, sideways))
    k = min(16, len(obstacles.points))
    _, index = cKDTree(obstacles.points).query((before + after) / 2, k=k, distance_upper_bound=reach)
    row, column = np.nonzero(index.reshape(len(before), k) < len(obstacles.points))
    j = index.reshape(len(before), k)[row, column]
    gap = obstacles.points[j] - before[row]
    along = np.einsum("ni,ni->n", gap, u[row])
    beside = np.linalg.norm(gap - along[:, None] * u[row], axis=1)
    faces = np.abs(np.einsum("ni,ni->n", obstacles.normals[j], u[row])) > FACING
    hit = (
        (along >= 0)
        & (along <= length[row])
        & (beside < sideways)
        & faces
        & (length[row] > 0.1 * length.max(initial=0.0))
    )
    return np.stack([row[hit], j[hit]], 1)


def moved(joint: Joint, points: np.ndarray, value: float) -> np.ndarray:
    """Points [N, 3] given at the start, with the joint at ``value`` (degrees or length)."""
    if joint.type == "prismatic":
        return points + value * joint.axis.double().numpy()
    T = se3.from_screw(joint.axis.double(), joint.origin.double(), math.radians(value)).numpy()
    return points @ T[:3, :3].T + T[:3, 3]


def step_size(joint: Joint, points: np.ndarray, spacing: float) -> float:
    """Joint step that moves the part's rim by half a point spacing."""
    if joint.type == "prismatic":
        return 0.5 * spacing
    axis = joint.axis.double().numpy()
    arm = points - joint.origin.double().numpy()
    rim = np.quantile(np.linalg.norm(arm - (arm @ axis)[:, None] * axis, axis=1), 0.95)
    return math.degrees(0.5 * spacing / max(float(rim), 1e-9))


def extended_limits(
    joint: Joint, points: np.ndarray, others_start: Obstacles, others_end: Obstacles, farthest: float
) -> tuple[float, float]:
    """The joint's limits (lo, hi), 0 = start, followed on beyond both observed states until the part touches.

    points [N, 3]: of the part at the start.  others_start, others_end: the other parts in both states; each end of the
    range is followed among the others as they were photographed there.  farthest: length beyond which no slide is
    followed, degrees are limited to ``FULL_TURN``. What the part passed through between the states cannot be in its way
    and is left out.
    """
    points = points[np.linspace(0, len(points) - 1, min(POINTS, len(points))).round().astype(int)]
    most = FULL_TURN if joint.type == "revolute" else farthest
    ends, onward = {}, math.copysign(1.0, joint.motion)
    for value, others, sign in ((0.0, others_start, -onward), (joint.motion, others_end, onward)):
        step = step_size(joint, points, others.spacing)
        others = others[harmless(joint, points, others, step)]
        hit = np.zeros(len(points), dtype=bool)
        at, here = value, moved(joint, points, value)
        while abs(at) < most:
            after = min(abs(at + sign * step), most) * (math.copysign(1, at + sign * step))
            there = moved(joint, points, after)
            hit[passed(here, there, others, others.spacing)[:, 0]] = True
            if hit.mean() > TOUCHING:
                break
            at, here = after, there
        ends[sign] = at
    return ends[-1.0], ends[1.0]


def harmless(joint: Joint, points: np.ndarray, others: Obstacles, step: float) -> np.ndarray:
    """Which obstacles stay, [N] bool: those the part did not run through in the middle of its observed motion."""
    keep = np.ones(len(others.points), dtype=bool)
    count = max(int(0.8 * abs(joint.motion) / step), 1)
    values = np.linspace(0.1, 0.9, count + 1) * joint.motion
    here = moved(joint, points, values[0])
    for value in values[1:]:
        there = moved(joint, points, value)
        keep[passed(here, there, others, others.spacing)[:, 1]] = False
        here = there
    return keep


def extend_ranges(obj: ArticulatedObject, min_opacity: float = 0.5) -> list[Part]:
    """The parts of a twin with their joints' limits followed on until they touch; the observed ones where a part has
    too few points."""
    solid = torch.sigmoid(obj.gaussians.opacity_logits) > min_opacity
    at = {t: {p.id: points_at(obj, p, solid, t) for p in obj.parts} for t in (0.0, 1.0)}
    everything = np.concatenate([*at[0.0].values(), *at[1.0].values()])
    if not len(everything):
        return list(obj.parts)
    lower, upper = np.quantile(everything, [0.001, 0.999], axis=0)
    farthest = float(np.linalg.norm(upper - lower))
    out = []
    for part in obj.parts:
        if part.joint is None or len(at[0.0][part.id]) < 10:
            out.append(part)
            continue
        others = [Obstacles.of(np.concatenate([x for k, x in at[t].items() if k != part.id])) for t in (0.0, 1.0)]
        limits = extended_limits(part.joint, at[0.0][part.id], others[0], others[1], farthest)
        lo, hi = min(limits[0], part.joint.limits[0]), max(limits[1], part.joint.limits[1])
        out.append(replace(part, joint=replace(part.joint, limits=(lo, hi))))
    return out


def points_at(obj: ArticulatedObject, part: Part, solid: torch.Tensor, t: float) -> np.ndarray:
    """Solid Gaussians of a part at state t, [N, 3] float64."""
    points = obj.gaussians.means[solid & (obj.part_ids == part.id)].double()
    if part.joint is not None:
        points = se3.apply(se3.screw_at(part.joint.transform.double(), t - obj.canonical_time), points)
    return points.numpy()
