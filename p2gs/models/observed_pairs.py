"""The pairs of observed centres that the articulation losses look at, and what they say of every part's rotation."""

from __future__ import annotations

import torch
from torch import Tensor

from p2gs.ops import so3


class ObservedPairs:
    """Gaussians that were observed in both states: index [M] int64 of ``paired`` [N] bool, and their centres there, mu0
    and mu1 [M, 3].

    Made anew only when the pairs change: the sums that rotations come from are over all of them, the same in every step
    but for the weights.
    """

    def __init__(self, paired: Tensor, mu0: Tensor, mu1: Tensor):
        self._of = (paired, mu0, mu1)
        self._versions = [t._version for t in self._of]
        self.index = paired.nonzero().squeeze(1)
        self.mu0, self.mu1 = mu0[self.index], mu1[self.index]
        # 1, source, target and their products by Gaussian, in double: moments about the origin cancel; nothing where
        # there is no pair
        s, d = mu0.double(), mu1.double()
        terms = torch.cat([torch.ones_like(s[:, :1]), s, d, (s[:, :, None] * d[:, None, :]).flatten(1)], 1)
        self._terms = torch.where(paired[:, None], terms, torch.zeros_like(terms))

    def are_of(self, paired: Tensor, mu0: Tensor, mu1: Tensor) -> bool:
        """Whether these very tensors, unchanged, are what this was made of."""
        now = (paired, mu0, mu1)
        return all(a is b for a, b in zip(self._of, now, strict=True)) and self._versions == [t._version for t in now]

    @torch.no_grad()
    def rotations(self, probs: Tensor) -> Tensor:
        """Rotations [K, 3, 3] of the motions that carry the pairs' mu0 to their mu1 best, weighted by probs [N, K]
        (``so3.kabsch``)."""
        sums = (probs.detach().T.double() + 1e-9) @ self._terms  # a part without mass follows the whole
        sums = sums / sums[:, :1].clamp_min(1e-300)
        s, d, both = sums[:, 1:4], sums[:, 4:7], sums[:, 7:].unflatten(1, (3, 3))
        return so3.nearest_rotation(both - s[:, :, None] * d[:, None, :]).to(probs.dtype)
