"""Which hypothesis is the room: the decision, and the sentences for captures that leave it open."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from p2gs.data.capture import board as marker_board
from p2gs.data.capture.hypotheses import MIN_VOTES, RIVAL, Hypothesis, State, extent, find_hypotheses
from p2gs.data.capture.joint import guided_pairs, state_bias, states_of
from p2gs.data.capture.model import Model
from p2gs.types import UserError

# of the cameras' distance: hypotheses that move the object's place by less than this are one; a board alone is as exact
SAME = 0.04
AROUND = 0.3  # of the cameras' distance: how far the object's surroundings go
LINKED = 0.001  # of the cameras' distance: states that lie, or may lie, farther apart than this are not joined
ADVICE = (
    "lay newspapers, a patterned rug or the printed board (p2gs data board) around the object and photograph "
    "both states again"
)


def apart(model: Model, A: np.ndarray, B: np.ndarray) -> float:
    """How far two similarities [4, 4] start -> end put the object's surroundings apart, over the cameras' distance."""
    centre, distance = model.centre()
    offsets = np.vstack([np.zeros(3), AROUND * distance * np.eye(3), -AROUND * distance * np.eye(3)])
    points = centre + offsets
    between = points @ (A - B)[:3, :3].T + (A - B)[:3, 3]
    scale = np.cbrt(np.linalg.det(A[:3, :3]))
    return float(np.linalg.norm(between, axis=1).max() / (scale * distance))


def hypotheses_of(start: State, end: State, seen: dict) -> list[Hypothesis]:
    """All hypotheses, widest first; each told whether the board agrees. The board's own is added where no other agrees
    with it."""
    found = find_hypotheses(start, end)
    T = marker_board.board_similarity(start.model, end.model, seen)
    if T is None:
        return found
    found = [replace(h, board=apart(start.model, h.T, T) < SAME) for h in found]
    if not any(h.board for h in found):
        pairs = guided_pairs(start, end, T)
        if len(pairs):
            found.append(Hypothesis(T, pairs, *extent(start.model, pairs[:, 0]), board=True))
    return found


def choose(found: list[Hypothesis], given: int | None, where: Path) -> int:
    """Index of the static hypothesis. given: the user's choice. Raises UserError, with what to do, where none can be
    trusted."""
    if given is not None:
        if not 0 <= given < len(found):
            raise UserError(f"--static {given}: there are {len(found)} hypotheses, counted from 0")
        return given
    if any(h.board for h in found):
        return max((i for i, h in enumerate(found) if h.board), key=lambda i: len(found[i].pairs))
    if not found:
        raise UserError(f"{where}: the two states show too little in common (fewer than {MIN_VOTES} points); {ADVICE}")
    if not found[0].wide:
        raise UserError(
            f"{where}: what both states show in common reaches over {found[0].spread:.2f} of the cameras' distance "
            "only, "
            f"so it may be a moving part and not the room; {ADVICE}"
        )
    rivals = [i for i, h in enumerate(found[1:], 1) if h.wide and h.spread > RIVAL * found[0].spread]
    if rivals:
        raise UserError(
            f"{where}: hypotheses 0 and {rivals[0]} both reach through the room, so something large moved besides "
            "the parts; leave the room as it is, or look at hypotheses.html in the scene's folder and choose with "
            f"--static 0 or --static {rivals[0]}"
        )
    return 0


def link(model: Model) -> float:
    """How far apart the states see what stands still in both, and how far it can be told (a standard deviation), the
    object's surroundings taken along, over the cameras' distance; NaN where three photographs of each state show too
    little of it."""
    bias, (_, distance) = state_bias(model), model.centre()
    return float((bias.shift + bias.shift_sd) / distance + AROUND * np.radians(bias.turn + bias.turn_sd))


def _told(apart: float) -> str:
    """``link`` in words."""
    return f"up to {100 * apart:.2f} % of the cameras' distance apart"


def check_link(apart: float, by_board: bool, where: Path) -> None:
    """Raises UserError where joined states do not see what stands still at one place (``link``), or do not see enough
    of it to say.  by_board: the marker board joins them."""
    if not apart < LINKED:
        seen = _told(apart) if np.isfinite(apart) else "too rarely"
        what = (
            "little but the marker board is seen to stand still in both states, and they see it"
            if by_board
            else "both states see what stands still"
        )
        more = "lay it where most photographs show it whole, or " if by_board else ""
        raise UserError(f"{where}: {what} {seen}; {more}{ADVICE}")


def loose_poses(model: Model) -> str | None:
    """What a user should know of poses that somebody else solved: that their states are not joined as well as is asked
    of a capture (``check_link``), or that they show too little to say. None where they are."""
    apart = link(model)
    if apart < LINKED:
        return None
    seen = (
        f"both states see what stands still {_told(apart)}, more than the {100 * LINKED:g} % that is asked of a capture"
        if np.isfinite(apart)
        else "too few points are seen in both states to say whether they lie in one frame"
    )
    return f"{seen}; if the open state hangs on what moved, its joints are wrong"


def check_joint_support(model: Model) -> dict:
    """Where the points lie that both states show, for poses that somebody else solved. Raises UserError where they are
    confined.

    A model whose points no photograph observes says nothing, and neither does this.
    """
    seen = states_of(model)
    if not seen.any():
        return {"points": 0}
    rows = np.flatnonzero(seen.all(1))
    if len(rows) < MIN_VOTES:
        raise UserError(
            f"the poses' two states share {len(rows)} points, expected at least {MIN_VOTES}: they need not lie in "
            f"one frame; {ADVICE}"
        )
    spread, outside = extent(model, rows)
    support = Hypothesis(np.eye(4), np.stack([rows, rows], 1), spread, outside)
    if not support.wide:
        raise UserError(
            f"the points that both states of these poses share reach over {spread:.2f} of the cameras' distance only, "
            f"so the open state may hang on a moving part; {ADVICE}"
        )
    return {"points": len(rows), "spread": spread, "outside": outside}
