"""A small articulated cloud for the tests of the part losses: a base, a door that turns, a drawer that slides;
float64."""

from dataclasses import replace

import torch

from p2gs.losses.base import LossInputs, PartState
from p2gs.ops import se3, so3
from p2gs.types import GaussianTensors

F64 = torch.float64


def transforms():
    door = se3.from_screw(torch.tensor([0.1, 0.2, 1.0], dtype=F64), torch.tensor([0.3, 0.0, 0.1], dtype=F64), 1.0)
    drawer = se3.from_screw(torch.tensor([1.0, 0.3, 0.0], dtype=F64), torch.zeros(3, dtype=F64), 0.0, 0.4)
    return torch.stack([torch.eye(4, dtype=F64), door, drawer])


def make_inputs(n=40, step=0, total=100, seed=0, noise=0.05, sharp=False):
    """n Gaussians in three parts, two thirds of them in pairs, soft memberships, canonical time 0.3."""
    g = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*shape, generator=g, dtype=F64)  # noqa: E731
    label = torch.randint(0, 3, (n,), generator=g)
    logits = draw(n, 3) + (50.0 if sharp else 2.0) * torch.nn.functional.one_hot(label, 3)
    T, time = transforms(), 0.3
    start = 0.4 * draw(n, 3)
    means = se3.apply(se3.screw_at(T, time), start)[label, torch.arange(n)]
    pairs = torch.randperm(n, generator=g)[: 2 * n // 3]
    mu0 = start[pairs]
    mu1 = se3.apply(T, mu0)[label[pairs], torch.arange(len(pairs))] + noise * draw(len(pairs), 3)
    knn = torch.cdist(means, means).fill_diagonal_(1e9).topk(4, largest=False).indices
    R_hat = so3.rotvec_to_matrix(so3.matrix_to_rotvec(T[:, :3, :3]) + 0.1 * draw(3, 3))
    state = PartState(
        probs=logits.softmax(-1),
        means_canonical=means,
        transforms=T,
        canonical_time=time,
        extent=2.0,
        spacing=0.2,
        pairs=pairs,
        mu0=mu0,
        mu1=mu1,
        knn=knn,
        target_rotation=R_hat,
        repel_points=0.5 * draw(12, 3),
    )
    gaussians = GaussianTensors(means, draw(n, 4), draw(n, 3), draw(n), draw(n, 1, 3))
    return LossInputs(step, total, gaussians, parts=state)


def with_parts(inputs, **changes):
    return replace(inputs, parts=replace(inputs.parts, **changes))


def turned(inputs, R, t):
    """The same scene seen from another world frame: every point p becomes R p + t."""
    p = inputs.parts
    W = se3.make(R, t)
    move = lambda x: se3.apply(W, x)  # noqa: E731
    return with_parts(
        inputs,
        means_canonical=move(p.means_canonical),
        mu0=move(p.mu0),
        mu1=move(p.mu1),
        transforms=W @ p.transforms @ se3.inverse(W),
        target_rotation=R @ p.target_rotation @ R.T,
        repel_points=move(p.repel_points),
    )


def permuted(inputs, order):
    """The same scene with its Gaussians in another order."""
    p = inputs.parts
    place = order.argsort()
    return with_parts(
        inputs,
        probs=p.probs[order],
        means_canonical=p.means_canonical[order],
        pairs=place[p.pairs],
        knn=place[p.knn[order]],
    )


def doubled(inputs):
    """Every Gaussian and every pair twice."""
    p = inputs.parts
    n = len(p.probs)
    return with_parts(
        inputs,
        probs=p.probs.repeat(2, 1),
        means_canonical=p.means_canonical.repeat(2, 1),
        pairs=torch.cat([p.pairs, p.pairs + n]),
        mu0=p.mu0.repeat(2, 1),
        mu1=p.mu1.repeat(2, 1),
        knn=torch.cat([p.knn, p.knn + n]),
    )
