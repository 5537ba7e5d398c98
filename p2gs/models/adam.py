"""Adam over named parameter groups, with one native call a step for all parameters in main memory."""

from __future__ import annotations

from typing import Any, Iterable

import torch
from torch.autograd.graph import increment_version

from p2gs.native import native, num_threads


class NamedAdam(torch.optim.Adam):
    """``torch.optim.Adam`` (Kingma and Ba 2015, arXiv:1412.6980) whose groups have names, without weight decay and
    AMSGrad.

    params: dicts {"params": [...], "name": str, "lr": float, ...}; names are unique.  The state is torch's (``step``,
    ``exp_avg``, ``exp_avg_sq``), so that checkpoints and the surgery of densification see nothing unusual. float32
    parameters on the CPU take the native kernel, on a GPU torch's fused step, anything else torch's own. eps defaults
    to 3DGS's 1e-15: gradients of Gaussians are small. Raises ValueError when a group has no name or a name comes twice.
    """

    def __init__(
        self,
        params: Iterable[dict[str, Any]],
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-15,
    ):
        params = list(params)
        names = [group.get("name") for group in params]
        if None in names or len(set(names)) != len(names):
            raise ValueError(f"every parameter group needs a name of its own, got {names}")
        on_cuda = all(p.is_cuda and p.dtype == torch.float32 for group in params for p in group["params"])
        super().__init__(params, lr=lr, betas=betas, eps=eps, fused=on_cuda or None)

    def group(self, name: str) -> dict[str, Any]:
        """The parameter group of that name. Raises KeyError."""
        for group in self.param_groups:
            if group["name"] == name:
                return group
        raise KeyError(name)

    def zero_grad(self, set_to_none: bool = True) -> None:
        """As torch's, without its bookkeeping, which takes longer than dropping a dozen gradients."""
        if not set_to_none:
            return super().zero_grad(set_to_none=False)
        for group in self.param_groups:
            for param in group["params"]:
                param.grad = None

    @torch.no_grad()
    def step(self, closure=None):
        """One update of every parameter that has a gradient; returns what ``closure`` returns."""
        if not self._native_applies():
            return super().step(closure)
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        # the kernel counts the steps too: ten tensors of one number take torch longer than it
        items, alive, touched = ([], [], [])
        for group in self.param_groups:
            (beta1, beta2), eps, lr = group["betas"], group["eps"], float(group["lr"])
            for param in group["params"]:
                if param.grad is None:
                    continue
                state = self.state[param]
                if not state:
                    state["step"] = torch.tensor(0.0)
                    state["exp_avg"] = torch.zeros_like(param)
                    state["exp_avg_sq"] = torch.zeros_like(param)
                grad = param.grad.contiguous()
                alive.append(grad)
                touched.append(param)
                items.append(
                    (
                        param.data_ptr(),
                        grad.data_ptr(),
                        _dense(state, "exp_avg").data_ptr(),
                        _dense(state, "exp_avg_sq").data_ptr(),
                        state["step"].data_ptr(),
                        param.numel(),
                        lr,
                        beta1,
                        beta2,
                        eps,
                    )
                )
        native.adam_step(items, num_threads())
        for param in touched:
            increment_version(param)  # autograd shall know of the write
        return loss

    def _native_applies(self) -> bool:
        return native is not None and all(
            p.dtype == torch.float32
            and p.device.type == "cpu"
            and p.is_contiguous()
            and (p.grad is None or (p.grad.dtype == torch.float32 and not p.grad.is_sparse))
            and self._counts_in_memory(p)
            for group in self.param_groups
            for p in group["params"]
        )

    def _counts_in_memory(self, param: torch.Tensor) -> bool:
        step = self.state[param].get("step") if param in self.state else None
        return step is None or (torch.is_tensor(step) and step.dtype == torch.float32 and step.device.type == "cpu")


def _dense(state: dict, key: str) -> torch.Tensor:
    if not state[key].is_contiguous():
        state[key] = state[key].contiguous()
    return state[key]
