"""Two parts without a seam are one body: where one thing ends and another begins that can move without it, photographs
show an edge (a gap, a step in colour or shade, what is behind) in at least one of the states, or surfaces tell the two
motions apart, as those of two doors on one hinge line that are open by unlike angles. A plain plate that was torn in
two, each piece with a motion that its plain surface hardly tells from the other's, has neither."""

from __future__ import annotations

from itertools import combinations
from typing import Sequence

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from p2gs.gaussians.handover import PartMotions
from p2gs.motion.refine_motions import Judge
from p2gs.native import at_once
from p2gs.parts.owners import label_map
from p2gs.parts.part_choices import without_part
from p2gs.visibility.free_space import SURFACE

VIEWS = 24  # photographs of a state that are looked at
EDGE = 2  # pixels on either side of a pixel within which an edge counts as there
FEWEST = 10  # pixels of common border by which a photograph shows two parts beside each other
MOST = 0.5  # share of such photographs without an edge, in both states, above which surfaces are asked
EIGHT = np.ones((3, 3), bool)  # neighbours of a pixel


def join_seamless(
    judge: Judge, motions: PartMotions, unproven: Sequence[tuple[int, int]] = ()
) -> tuple[PartMotions, list[dict]]:
    """One part for every two that have a common border in both states and no edge along it (``seamless``), and that
    surfaces do not tell apart: as one, with the motion of either, refined, whichever explains more, their energy is no
    higher. Of two that nothing tells apart so far, pairs ``unproven`` with the larger index last, both states must show
    an edge. Returns the motions and what was asked: the two parts, the shares of photographs without an edge, by how
    much the surfaces' energy is higher as one, and whether they were joined."""
    log: list[dict] = []
    while (found := _joined(judge, motions, log, unproven)) is not None:
        motions, gone = found
        left = [p for p in unproven if gone not in p]
        unproven = [(a - (a > gone), b - (b > gone)) for a, b in left]
    return motions, log


def _joined(
    judge: Judge, motions: PartMotions, log: list[dict], unproven: Sequence[tuple[int, int]]
) -> tuple[PartMotions, int] | None:
    """The motions with two parts as one, those with fewest edges between them first, and which part went; None where
    no two are."""
    shares = seamless(judge, motions) if len(motions) > 1 else {}
    plain = [p for p, of in shares.items() if min(of) > MOST or (p in unproven and max(of) >= MOST)]
    for a, b in sorted(plain, key=lambda p: -min(shares[p])):
        one, other = at_once(judge.refine, [without_part(motions, a, b + 1), without_part(motions, b, a + 1)])
        fewer, gone = (one, a) if judge.gain(one, other) > 0 else (other, b)
        worse = judge.surfaces(fewer) - judge.surfaces(motions)
        asked = {"parts": [a, b], "without_edge": list(shares[a, b]), "surfaces": worse, "joined": worse <= 0}
        log.append(asked)
        if asked["joined"]:
            return fewer, gone
    return None


def seamless(judge: Judge, motions: PartMotions) -> dict[tuple[int, int], tuple[float, float]]:
    """Of each two parts that photographs of both states show beside each other at one depth, the share of these
    photographs, by state, in which no edge parts them (``parted_by_an_edge``)."""
    seen = at_once(lambda s: _seen(judge, motions, s), (0, 1))
    return {p: (float(np.mean(seen[0][p])), float(np.mean(seen[1][p]))) for p in seen[0].keys() & seen[1].keys()}


def _seen(judge: Judge, motions: PartMotions, state: int) -> dict[tuple[int, int], list[bool]]:
    """Of each two parts of a state, of every photograph that shows them beside each other whether no edge parts
    them."""
    views, g = judge.views[state], judge.states[state].gaussians.to(judge.device)
    shares = torch.nn.functional.one_hot(motions.labels[state].clamp_min(0), len(motions) + 1).float().to(judge.device)
    out: dict[tuple[int, int], list[bool]] = {}
    for i in views.spread(VIEWS):
        shot = views.get(i, len(views.levels) - 1, torch.full((3,), 0.5))
        part, drawn = label_map(g, shares, shot.camera.to(judge.device), judge.backend)
        part = torch.where(drawn.alpha.cpu() > 0.5, part, -1).numpy()
        contrast, depth = contrast_of(shot.image), drawn.expected_depth.cpu().numpy()
        for a, b in combinations(range(len(motions)), 2):
            clear = ndimage.binary_erosion((part == a + 1) | (part == b + 1), iterations=EDGE + 1, structure=EIGHT)
            one, two = (part == a + 1) & clear, (part == b + 1) & clear
            if touching(one, two, depth, judge.config.free_static or SURFACE) >= FEWEST:
                out.setdefault((a, b), []).append(not parted_by_an_edge(contrast, one, two))
    return out


def touching(one: np.ndarray, two: np.ndarray, depth: np.ndarray, near: float) -> int:
    """How many pixels of two regions [H, W] lie beside one of the other at the same depth [H, W], to within
    ``near``."""
    out = 0
    for axis in (0, 1):
        here, there = (slice(None),) * axis + (slice(1, None),), (slice(None),) * axis + (slice(None, -1),)
        level = np.abs(depth[here] - depth[there]) < near
        out += int((level & ((one[here] & two[there]) | (two[here] & one[there]))).sum())
    return out


def contrast_of(image: Tensor) -> np.ndarray:
    """[H, W] how much an image [H, W, 3], smoothed over three pixels, varies within ``EDGE`` pixels of each pixel, mean
    of the channels."""
    smooth = ndimage.uniform_filter(image.numpy(), (3, 3, 0))  # pyright: ignore
    size = (2 * EDGE + 1, 2 * EDGE + 1, 0)
    return (ndimage.maximum_filter(smooth, size) - ndimage.minimum_filter(smooth, size)).mean(2)


def parted_by_an_edge(contrast: np.ndarray, one: np.ndarray, two: np.ndarray) -> bool:
    """Whether two regions [H, W] bool are apart where each hangs together: at the least contrast [H, W] below which
    most of each is in one piece, most of both is in no common one. Texture and noise raise that contrast for all alike;
    only an edge that runs all along between them parts them."""
    both = one | two
    rows, columns = np.where(both.any(1))[0], np.where(both.any(0))[0]
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    contrast, one, two, both = contrast[window], one[window], two[window], both[window]
    levels = np.unique(contrast[both])
    low, high = 0, len(levels) - 1
    while low < high:  # pieces only grow with the level
        level = (low + high) // 2
        if all(_largest(contrast <= levels[level], region) >= region.sum() / 2 for region in (one, two)):
            high = level
        else:
            low = level + 1
    piece = _pieces((contrast <= levels[low]) & both)
    shares = [np.bincount(piece[region], minlength=piece.max() + 1)[1:] / region.sum() for region in (one, two)]
    return not bool(((shares[0] >= 0.5) & (shares[1] >= 0.5)).any())


def _largest(open_: np.ndarray, region: np.ndarray) -> int:
    """Pixels of the largest piece of a region [H, W] where it is open."""
    return int(np.bincount(_pieces(open_ & region).ravel(), minlength=2)[1:].max())


def _pieces(mask: np.ndarray) -> np.ndarray:
    """[H, W] the number of each pixel's connected component of the mask [H, W], 0 outside it."""
    return ndimage.label(mask, EIGHT)[0]  # pyright: ignore
