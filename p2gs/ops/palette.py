"""One colour per part, the same in every picture, plot and export."""

from __future__ import annotations

import colorsys

import torch
from torch import Tensor

STATIC_COLOUR = (0.66, 0.68, 0.72)
# distinct for colour-blind readers too (after Okabe and Ito), the brightest first
MOVING_COLOURS = (
    (0.90, 0.45, 0.05),
    (0.10, 0.50, 0.85),
    (0.10, 0.65, 0.45),
    (0.85, 0.25, 0.55),
    (0.95, 0.80, 0.15),
    (0.50, 0.35, 0.80),
    (0.40, 0.75, 0.95),
)


def part_colour(part_id: int) -> tuple[float, float, float]:
    """RGB in 0..1: grey for the base, seven fixed colours, then hues a golden angle apart."""
    if part_id == 0:
        return STATIC_COLOUR
    if part_id <= len(MOVING_COLOURS):
        return MOVING_COLOURS[part_id - 1]
    return colorsys.hsv_to_rgb((0.08 + 0.618034 * part_id) % 1.0, 0.7, 0.85)


def part_colours(count: int) -> Tensor:
    """[count, 3] float32, one row a part."""
    return torch.tensor([part_colour(k) for k in range(count)])
