"""Two renderings of one object from the same cameras, compared: masks, depth, ground truth.

    python bench/render_check.py SCENE OTHER

SCENE was made by ``p2gs data render ... --cameras OTHER``. Prints the intersection over union of the masks (mean and
least of all views), the differences of depth as shares of the object's size (median, 99 of 100; pixels whose eight
neighbours lie within a hundredth of the size in both), the greatest difference of ground truth's numbers, and the mean
difference of the colours.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from p2gs.data.base import DATASETS
from p2gs.data.ground_truth import load_ground_truth
from p2gs.data.layouts import detect_format
from p2gs.data.modules import ArtGSData  # noqa: F401  (registers the layouts)


def smooth(depth: np.ndarray, limit: float) -> np.ndarray:
    """Pixels [H, W] whose neighbours all have a depth within ``limit`` of theirs."""
    out = depth > 0
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            other = np.roll(depth, (dy, dx), (0, 1))
            out &= (other > 0) & (np.abs(other - depth) < limit)
    return out


def compare(one: Path, two: Path) -> dict[str, float]:
    scenes = [DATASETS[detect_format(p)](str(p)).raw_scene() for p in (one, two)]
    size = 2.0  # the unit ball
    overlaps, depths, colours = [], [], []
    for a in scenes[0].views:
        b = next(v for v in scenes[1].views if (v.state, v.split, v.name) == (a.state, a.split, a.name))
        masks = [v.alpha.numpy() > 127 for v in (a, b)]
        both = masks[0] & masks[1]
        overlaps.append(both.sum() / max((masks[0] | masks[1]).sum(), 1))
        colours.append(np.abs(a.image.numpy().astype(int) - b.image.numpy().astype(int))[both].mean())
        if a.depth is not None and b.depth is not None:
            pair = [v.depth.numpy() for v in (a, b)]
            flat = smooth(pair[0], size / 100) & smooth(pair[1], size / 100)
            depths.append(np.abs(pair[0] - pair[1])[flat] / size)
    joints = [load_ground_truth(p).joints for p in (one, two)]
    apart = max(
        float((getattr(a, name).double() - getattr(b, name).double()).abs().max())
        for a, b in zip(*joints, strict=True)
        for name in ("axis", "origin", "transform")
    )
    out = {"iou_mean": np.mean(overlaps), "iou_least": np.min(overlaps), "ground_truth": apart}
    if depths:
        out |= {
            "depth_median": np.median(np.concatenate(depths)),
            "depth_99": np.quantile(np.concatenate(depths), 0.99),
        }
    return {k: float(v) for k, v in (out | {"colour": np.mean(colours)}).items()}


if __name__ == "__main__":
    for key, value in compare(Path(sys.argv[1]), Path(sys.argv[2])).items():
        print(f"{key} {value:.6f}")
