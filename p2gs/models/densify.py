"""Growing and pruning Gaussians within a budget, by the gradient of their projected centres."""

from __future__ import annotations

import torch
from torch import Tensor

from p2gs.gaussians.splats import Splats, gather
from p2gs.ops.so3 import quat_to_matrix


def densify(
    splats: Splats,
    optimizer: torch.optim.Optimizer,
    target: int | None,
    *,
    generator: torch.Generator,
    min_opacity: float = 0.005,
    max_scale: float = 0.1,
    split_scale: float = 0.01,
    max_growth: float = 0.15,
    threshold: float = 0.0,
) -> tuple[int, int]:
    """Prune Gaussians that are faint, huge or in no view since the last call, then grow towards ``target`` by
    copying those with the largest mean screen gradient.

    Gaussians larger than ``split_scale`` (internal units, largest axis) are split: both copies are shrunk by 1.6 and
    the second is drawn from the first's density; smaller ones are cloned in place with both opacities lowered so that
    the pair is as opaque as the one was. At most ``max_growth`` of the present count is added in one call.
    Gradient-ranked growth to a budget rather than a threshold keeps time and memory predictable.
    threshold: above 0, every Gaussian grows whose mean screen gradient exceeds it (3DGS's rule; loss per half the
    image's height, of absolute gradients), and ``target`` (None: nothing) is all that limits their number.

    Returns (added, pruned). Raises ValueError without both target and threshold.
    """
    if target is None and threshold <= 0:
        raise ValueError("densify needs a target or a threshold")
    with torch.no_grad():
        opacity = torch.sigmoid(splats.opacity_logits)
        scale = splats.log_scales.exp().amax(dim=1)
        finite = torch.isfinite(splats.means).all(dim=1) & torch.isfinite(scale)
        # what no view sees is never carved away
        watched = splats.seen > 0 if bool((splats.seen > 0).any()) else torch.ones_like(finite)
        keep = (opacity > min_opacity) & (scale < max_scale) & finite & watched
        if not keep.any():
            keep = finite  # an object that is not there yet: prune nothing but garbage
        kept = keep.nonzero().squeeze(1)
        room = kept.numel() if target is None else target - kept.numel()
        if threshold <= 0:
            room = min(room, int(max_growth * kept.numel()) + 1)
        grown = kept[:0]
        if room > 0:
            score = (splats.grad_sum / splats.seen.clamp_min(1))[kept]
            # stable sort: ties must not depend on the thread count
            order = torch.sort(score, descending=True, stable=True).indices[:room]
            # the statistics are per image height, twice the gradient per half of it
            grown = kept[order[score[order] > 2 * threshold]]
        index = torch.cat([kept, grown])
        fresh = torch.zeros(index.numel(), dtype=torch.bool, device=index.device)
        fresh[kept.numel() :] = True
        first = torch.searchsorted(kept, grown)
        gather(splats, optimizer, index, fresh)
        _separate(splats, first, torch.arange(kept.numel(), index.numel(), device=index.device), split_scale, generator)
    return grown.numel(), int((~keep).sum())


@torch.no_grad()
def reset_opacity(splats: Splats, optimizer: torch.optim.Optimizer, opacity: float) -> None:
    """No Gaussian stays more opaque than ``opacity``; the optimiser forgets its moments of opacities (3DGS's reset)."""
    splats.opacity_logits.data.clamp_(max=float(torch.logit(torch.tensor(opacity))))
    for key, value in optimizer.state.get(splats.opacity_logits, {}).items():
        if torch.is_tensor(value) and key != "step":
            value.zero_()


def _separate(splats: Splats, first: Tensor, second: Tensor, split_scale: float, generator: torch.Generator) -> None:
    """Make the pairs (first, second) of equal Gaussians differ: split the large, share the opacity of the small."""
    if first.numel() == 0:
        return
    scales = splats.log_scales[first].exp()
    large = scales.amax(dim=1) > split_scale
    noise = torch.randn(first.numel(), 3, generator=generator).to(scales)
    offset = torch.einsum("nij,nj->ni", quat_to_matrix(splats.quats[first]), scales * noise)
    splats.means.data[second[large]] += offset[large]
    for rows in (first[large], second[large]):
        splats.log_scales.data[rows] -= 0.47  # ln 1.6
    small = ~large
    splats.means.data[second[small]] += 0.1 * offset[small]
    half = 1 - torch.sqrt(1 - torch.sigmoid(splats.opacity_logits[first[small]]).clamp(max=0.999))
    logit = torch.logit(half.clamp(1e-4, 1 - 1e-4))
    splats.opacity_logits.data[first[small]] = logit
    splats.opacity_logits.data[second[small]] = logit
