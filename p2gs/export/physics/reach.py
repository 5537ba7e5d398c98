"""``--extend-range``: how far a joint goes on beyond the two photographed states, by moving its collision pieces until
they touch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from p2gs.export.links import Link, joint_motion
from p2gs.export.physics.clearance import GAP, Body, body_of, touches

FULL_TURN = np.pi  # rad beyond which no hinge is followed
HELD = 0.1  # share of a slide's length that stays within the base's along the axis, as runners hold a drawer
STEPS = 32  # of a full turn, or of the base's length: between two of them a piece is followed by the hull of both poses
HALVINGS = 6  # of the step in which parts touch


def extend_links(links: list[Link]) -> list[Link]:
    """The links (cleared of one another, ``links[0]`` the base) with joint limits that go on until pieces touch.

    Each end of a joint's range is followed among the other parts as they were in that photographed state; half of the
    gap that clearing left stays. What was observed stays within the limits, and is all that a slide without a base has.
    """
    bodies = [body_of(link) for link in links]
    points = np.concatenate([p.vertices for b in bodies for p in b.pieces])
    margin = 0.5 * GAP * float(np.linalg.norm(np.ptp(points, axis=0)))
    out = list(links)
    for i, a in enumerate(bodies):
        if a.joint is None or not a.pieces:
            continue
        ends = [a.hinge.lower, a.hinge.upper]
        onward = 1 if a.hinge.motion >= 0 else -1
        for state, direction in ((0.0, -onward), (1.0, onward)):
            others = [
                (b, np.eye(4) if b.joint is None else joint_motion(b.hinge, state * b.hinge.motion))
                for b in bodies
                if b is not a
            ]
            reached = follow(a, others, bodies[0], state * a.hinge.motion, direction, margin)
            ends = [min(ends[0], reached), max(ends[1], reached)]
        out[i] = replace(links[i], joint=replace(a.hinge, lower=ends[0], upper=ends[1]))
    return out


def follow(
    a: Body, others: list[tuple[Body, np.ndarray]], base: Body, start: float, direction: int, margin: float
) -> float:
    """The joint value up to which ``a`` goes from ``start`` in ``direction`` (1 or -1) without coming within ``margin``
    of the others.

    others: with their poses [4, 4].
    """
    if a.hinge.type == "prismatic" and not base.pieces:  # nothing that would hold it
        return start
    farthest = _farthest(a, base, direction)
    step = (FULL_TURN if a.hinge.type == "revolute" else float(np.ptp(_along(base, a.hinge.axis)))) / STEPS
    at, halved = start, 0
    while halved <= HALVINGS and direction * (farthest - at) > 1e-9:
        there = at + direction * min(step, direction * (farthest - at))
        if any(touches(a, b, np.array([at, there]), pose, margin) for b, pose in others):
            step, halved = step / 2, halved + 1
        else:
            at = there
    return at


def _farthest(a: Body, base: Body, direction: int) -> float:
    """Joint value beyond which nothing is followed."""
    if a.hinge.type == "revolute":
        return direction * FULL_TURN
    own, rest = _along(a, a.hinge.axis), _along(base, a.hinge.axis)
    held = HELD * np.ptp(own)
    return float(rest.max() - held - own.min() if direction > 0 else rest.min() + held - own.max())


def _along(body: Body, axis: np.ndarray) -> np.ndarray:
    return np.concatenate([p.vertices for p in body.pieces]) @ axis
