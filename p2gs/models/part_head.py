"""Part-identity embeddings psi and their shared linear classifier f (paper section 4.2): F(G) = softmax(f(psi))."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from p2gs.ops.assign import soft_assignment


class PartHead(nn.Module):
    """f: [N, dim] -> [N, K] logits. psi itself is a per-Gaussian parameter of ``Splats`` (it follows densification)."""

    def __init__(self, dim: int, parts: int, generator: torch.Generator):
        super().__init__()
        # orthonormal rows: no part starts out more like another
        basis = torch.linalg.qr(torch.randn(max(dim, parts), max(dim, parts), generator=generator)).Q
        self.weight = nn.Parameter(basis[:parts, :dim].contiguous())
        self.bias = nn.Parameter(torch.zeros(parts))

    def forward(self, psi: Tensor, temperature: float = 1.0) -> Tensor:
        """psi [N, dim] -> probabilities [N, K]."""
        return soft_assignment(psi, self.weight, self.bias, temperature)

    def embed(self, labels: Tensor, sureness: Tensor) -> Tensor:
        """Embeddings [N, dim] whose logits favour ``labels`` [N] by ``sureness`` [N]."""
        return self.weight.detach()[labels] * sureness[:, None]


def random_embeddings(count: int, dim: int, generator: torch.Generator) -> Tensor:
    """Small random start, [N, dim] (the paper's own)."""
    return 0.1 * torch.randn(count, dim, generator=generator)
