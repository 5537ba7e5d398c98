"""Numbers that must not go on: a loss that is not finite, a state without Gaussians, a result with NaN in it."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Iterator

import torch
from torch import Tensor, nn

from p2gs.types import GaussianTensors, UserError

NUMBERS = (*GaussianTensors.NAMES, "transforms", "probs", "betas")  # fields of hand-over objects


class LossNotFinite(UserError):
    """The loss of a step is NaN or infinite. Raised before the backward pass: parameters are still those of the step
    before."""


def check_loss(stage: str, step: int, scalars: dict[str, Tensor | float]) -> None:
    """Raise LossNotFinite where ``scalars["loss/total"]`` is NaN or infinite; the sentence names the terms that are."""
    if math.isfinite(float(scalars["loss/total"])):
        return
    terms = {name.removeprefix("loss/"): float(value) for name, value in scalars.items() if name.startswith("loss/")}
    wrong = {name: value for name, value in terms.items() if name != "total" and not math.isfinite(value)}
    which = ", ".join(f"{name} is {value}" for name, value in wrong.items()) or "the terms are finite, their sum is not"
    option = f"phases.{section_of_stage(stage)}.losses.{next(iter(wrong), 'NAME')}"
    raise LossNotFinite(
        f"{stage}: the loss is not finite at step {step} ({which}); the stage stopped with the state before that "
        "step, which "
        f"checkpoints/{stage}.ckpt keeps where checkpoints are on; lower the learning rates or that loss's weight, "
        f"or leave it out ({option})"
    )


def check_gaussians(stage: str, count: int, before: int | None = None) -> None:
    """Raise UserError where no Gaussian is left. before: how many there were before what removed the last."""
    if count == 0:
        were = "" if not before else f" of {before}, no training view sees any"
        raise UserError(
            f"{stage}: the reconstruction has collapsed, no Gaussian is left{were}; expected an object: look at the "
            "masks "
            "(p2gs data check) and at callbacks.densify (min_opacity, max_scale), or train with lower learning rates"
        )


def check_result(stage: str, value: Any) -> None:
    """Raise UserError where a tensor of Gaussians, motions or assignments that a stage hands over holds NaN or
    infinity."""
    for name, tensor in _tensors(value):
        wrong = ~torch.isfinite(tensor)
        if bool(wrong.any()):
            count = f"{int(wrong.sum())} of {tensor.numel()}"
            raise UserError(f"{stage}: {count} numbers of its result's '{name}' are not finite; nothing was kept")


def all_finite(module: nn.Module) -> bool:
    """Whether every parameter is finite."""
    return all(bool(torch.isfinite(p).all()) for p in module.parameters())


def section_of_stage(stage: str) -> str:
    """``single_state`` of ``single_state_0``: the phase whose options a stage has."""
    return stage[:-2] if stage.endswith(("_0", "_1")) else stage


def _tensors(value: Any) -> Iterator[tuple[str, Tensor]]:
    """Tensors of a hand-over object whose every entry has to be a number (margins may be infinite: nothing
    contends)."""
    if not dataclasses.is_dataclass(value):
        return
    for f in dataclasses.fields(value):
        item = getattr(value, f.name)
        if dataclasses.is_dataclass(item):
            yield from _tensors(item)
        elif isinstance(item, Tensor) and f.name in NUMBERS:
            yield f.name, item
