"""Losses by name. Importing this package registers all of them."""

from p2gs.losses import geometry, motion, parts, photometric, physics
from p2gs.losses.base import LOSSES, Loss, LossInputs, PartState, Target, register_loss

__all__ = [
    "LOSSES",
    "Loss",
    "LossInputs",
    "PartState",
    "Target",
    "register_loss",
    "geometry",
    "motion",
    "parts",
    "photometric",
    "physics",
]
