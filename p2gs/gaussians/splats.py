"""The trainable Gaussians: named parameters and buffers that share their first dimension, and change size together."""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor, nn

from p2gs.types import GaussianTensors


class SplitGaussians(GaussianTensors):
    """Gaussians whose harmonics lie in two tensors, sh0 [N, 1, 3] and sh_rest [N, B-1, 3]; ``sh`` is joined when it is
    asked for."""

    def __init__(
        self, means: Tensor, quats: Tensor, log_scales: Tensor, opacity_logits: Tensor, sh0: Tensor, sh_rest: Tensor
    ):
        self.means, self.quats, self.log_scales, self.opacity_logits = means, quats, log_scales, opacity_logits
        self.sh0, self.sh_rest = sh0, sh_rest

    @cached_property
    def sh(self) -> Tensor:
        """[N, B, 3]."""
        return torch.cat([self.sh0, self.sh_rest], dim=1)

    def placed(self, means: Tensor, quats: Tensor) -> "SplitGaussians":
        return SplitGaussians(means, quats, self.log_scales, self.opacity_logits, self.sh0, self.sh_rest)


class Splats(nn.Module):
    """N Gaussians as parameters, with any number of further per-Gaussian parameters (``extra``) and buffers
    (``carried``).

    Parameters: means [N, 3], quats [N, 4], log_scales [N, 3], opacity_logits [N], sh0 [N, 1, 3], sh_rest [N, B-1, 3],
    then ``extra``. Buffers: grad_sum [N] and seen [N] (densification statistics), then ``carried``. Every one has first
    dimension N, so that ``gather`` (the only function that changes N) treats them alike. A checkpoint with another N
    loads: the tensors are resized first.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh0: Tensor
    sh_rest: Tensor
    grad_sum: Tensor
    seen: Tensor
    # extra and carried ones of fusion and articulation
    psi: Tensor
    labels: Tensor
    margin: Tensor
    paired: Tensor
    mu0: Tensor
    mu1: Tensor
    offsets: Tensor

    def __init__(
        self,
        gaussians: GaussianTensors,
        extra: dict[str, Tensor] | None = None,
        carried: dict[str, Tensor] | None = None,
    ):
        super().__init__()
        n = len(gaussians)
        values = {
            "means": gaussians.means,
            "quats": gaussians.quats,
            "log_scales": gaussians.log_scales,
            "opacity_logits": gaussians.opacity_logits,
            "sh0": gaussians.sh[:, :1],
            "sh_rest": gaussians.sh[:, 1:],
            **(extra or {}),
        }
        for name, value in values.items():
            if value.shape[0] != n:
                raise ValueError(f"'{name}' has {value.shape[0]} rows, expected {n} (one per Gaussian)")
            setattr(self, name, nn.Parameter(value.detach().clone().contiguous()))
        buffers = {"grad_sum": torch.zeros(n), "seen": torch.zeros(n), **(carried or {})}
        for name, value in buffers.items():
            if value.shape[0] != n:
                raise ValueError(f"'{name}' has {value.shape[0]} rows, expected {n} (one per Gaussian)")
            self.register_buffer(name, value.detach().clone().contiguous())
        self.register_load_state_dict_pre_hook(self._resize)

    @staticmethod
    def _resize(module: "Splats", state_dict, prefix, *_) -> None:
        for name, own in [*module.named_parameters(recurse=False), *module.named_buffers(recurse=False)]:
            stored = state_dict.get(prefix + name)
            if stored is not None and stored.shape != own.shape:
                own.data = own.data.new_empty(stored.shape)

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def sh(self) -> Tensor:
        """[N, B, 3]."""
        return torch.cat([self.sh0, self.sh_rest], dim=1)

    def tensors(self) -> GaussianTensors:
        """The parameters as they are (with gradients)."""
        return SplitGaussians(self.means, self.quats, self.log_scales, self.opacity_logits, self.sh0, self.sh_rest)

    def note_gradients(self, abs_grad: Tensor, radii: Tensor, scale: float) -> None:
        """Add one view's screen-space gradients (|d loss / d mean2d|, [N], pixels) to the statistics, times
        ``scale``."""
        seen = radii > 0
        self.grad_sum += torch.where(seen, abs_grad * scale, torch.zeros_like(abs_grad))
        self.seen += seen


def gather(splats: Splats, optimizer: torch.optim.Optimizer, index: Tensor, fresh: Tensor) -> None:
    """Replace the N Gaussians by rows ``index`` [M] of themselves: drops, copies and reorders. The one place of
    optimiser surgery.

    fresh [M] bool: rows that start with empty optimiser moments (new Gaussians). Densification statistics restart at
    zero. The optimiser's ``step`` counters stay.
    """
    if index.shape != fresh.shape:
        raise ValueError(f"index {tuple(index.shape)} and fresh {tuple(fresh.shape)} differ in shape")
    with torch.no_grad():
        for name, old in list(splats.named_parameters(recurse=False)):
            new = nn.Parameter(old.detach()[index].contiguous(), requires_grad=old.requires_grad)
            setattr(splats, name, new)
            for group in optimizer.param_groups:
                group["params"] = [new if p is old else p for p in group["params"]]
            state = optimizer.state.pop(old, None)
            if state:
                for key, value in state.items():
                    if torch.is_tensor(value) and value.shape == old.shape:
                        moved = value[index].contiguous()
                        moved[fresh] = 0
                        state[key] = moved
                optimizer.state[new] = state
        for name, old in list(splats.named_buffers(recurse=False)):
            setattr(splats, name, old[index].contiguous())
        splats.grad_sum.zero_()
        splats.seen.zero_()
