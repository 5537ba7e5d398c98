"""Masks that are a pixel or two too wide or too narrow, each photograph's by its own amount.

A segmentation's edge lies beside the object's, in one photograph farther out and in the next farther in. All
photographs of a state together still say where the object ends: what they have been reconstructed to is drawn, and each
mask's edge is held against the edge of the drawing. By how much all are too wide nobody can tell from an object that is
larger, so the mean is held at zero. What is on is decided as for exposures: what half of a mask's edge says must
explain the other half.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from p2gs.data.views import TargetImage
from p2gs.models.trial import Trial, halves, trial
from p2gs.motion.on_grey import drawing
from p2gs.types import GaussianTensors, View


def signed_distance(inside: np.ndarray) -> np.ndarray:
    """[H, W] pixels from the edge between True and False, positive inside; ``inside`` [H, W] bool has both."""
    within, beside = (np.asarray(distance_transform_edt(x)) for x in (inside, ~inside))
    return np.where(inside, within - 0.5, 0.5 - beside)


def middle_mean(values: np.ndarray) -> float:
    """Mean of the middle half: bites and blobs on an edge are in neither tail."""
    low, high = np.quantile(values, [0.25, 0.75])
    return float(values[(values >= low) & (values <= high)].mean())


def edge_distances(g: GaussianTensors, shot: TargetImage, backend: str) -> np.ndarray | None:
    """[n, 2] of the pixels on both sides of a mask's edge: which half of the picture they are in (0 or 1), and how far
    outside the drawn outline they lie, as a share of the whole picture's long edge; None where there is no edge or no
    outline."""
    drawn = drawing(g, shot.camera, backend).alpha.cpu().numpy() > 0.5
    mask = shot.alpha.cpu().numpy() > 0.5
    edge = np.abs(signed_distance(mask)) == 0.5 if mask.any() and not mask.all() else np.zeros_like(mask)
    if not edge.any() or drawn.all() or not drawn.any():
        return None
    half = halves(*mask.shape)[0].numpy()
    return np.stack([half[edge], -signed_distance(drawn)[edge] / long_edge(shot)], 1)


def long_edge(shot: TargetImage) -> int:
    """Of the whole picture, of which ``shot`` is a crop, in its pixels."""
    return max(shot.key[3:5])


def growths_of(edges: list[np.ndarray | None]) -> Tensor:
    """[V] float64: by how much each mask is too wide, share of the long edge, mean zero; 0 where none can tell."""
    found = torch.tensor([0.0 if e is None else middle_mean(e[:, 1]) for e in edges], dtype=torch.float64)
    return found - found.mean()


def try_masks(edges: list[np.ndarray | None]) -> Trial:
    """Distances of half edges from the drawn outlines as they are, and after the growth that their other halves tell,
    as it differs from the photographs' mean."""
    split = [[e[e[:, 0] == half, 1] for half in (0, 1)] for e in edges if e is not None]
    halved = [both for both in split if all(map(len, both))]
    if len(halved) < 2:
        return trial(torch.ones(1), torch.ones(1))
    told = np.array([[middle_mean(half) for half in both] for both in halved])
    mean = told.mean()
    off = np.zeros((2, len(halved)))
    for k, both in enumerate(halved):
        for half, growth in zip(both, told[k, ::-1], strict=True):
            off[:, k] += np.abs(half - mean).mean(), np.abs(half - growth).mean()
    return trial(*torch.from_numpy(off))


def regrown(view: View, growth: float) -> View:
    """The photograph with its mask narrower by ``growth`` (share of the long edge; below 0: wider). Pixels that come in
    have the colour of the nearest that was in; a mask that would vanish stays."""
    inside = view.alpha.numpy() > 127
    if growth == 0 or not inside.any() or inside.all():
        return view
    alpha = np.clip(signed_distance(inside) - growth * max(inside.shape) + 0.5, 0, 1)
    if not (alpha > 0.5).any():
        return view
    right = replace(view, alpha=torch.from_numpy((alpha * 255).round().astype(np.uint8)))
    if growth > 0:
        return right  # nothing comes in
    row, column = np.asarray(distance_transform_edt(~inside, return_distances=False, return_indices=True))
    return replace(right, image=view.image[row, column])
