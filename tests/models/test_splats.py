"""Gaussians change size in one place, and the optimiser follows."""

import pytest
import torch
from tiny import random_gaussians

from p2gs.callbacks.densify import Densify
from p2gs.gaussians.splats import Splats, gather
from p2gs.models.densify import densify, reset_opacity
from p2gs.types import UserError


def trained(n: int = 6) -> tuple[Splats, torch.optim.Adam]:
    splats = Splats(
        random_gaussians(n),
        extra={"psi": torch.arange(n * 2.0).reshape(n, 2)},
        carried={"mu0": torch.arange(n * 3.0).reshape(n, 3)},
    )
    optimizer = torch.optim.Adam([{"params": [p], "name": name} for name, p in splats.named_parameters()], lr=0.1)
    for _ in range(3):
        optimizer.zero_grad()
        sum((p * (1 + torch.arange(p.numel()).reshape(p.shape))).sum() for p in splats.parameters()).backward()
        optimizer.step()
    return splats, optimizer


def test_gather_moves_every_row_and_its_moments():
    splats, optimizer = trained()
    before = {n: p.detach().clone() for n, p in splats.named_parameters()}
    moments = {n: optimizer.state[p]["exp_avg"].clone() for n, p in splats.named_parameters()}
    index, fresh = torch.tensor([4, 0, 0, 5]), torch.tensor([False, False, True, False])
    gather(splats, optimizer, index, fresh)
    assert len(splats) == 4
    for name, p in splats.named_parameters():
        assert torch.equal(p, before[name][index])
        expected = moments[name][index]
        expected[2] = 0
        assert torch.equal(optimizer.state[p]["exp_avg"], expected)
    assert torch.equal(splats.mu0, torch.arange(18.0).reshape(6, 3)[index])
    held = [p for group in optimizer.param_groups for p in group["params"]]
    assert {id(p) for p in held} == {id(p) for p in splats.parameters()}
    assert len(optimizer.state) == len(held)  # nothing left behind of the old tensors


def test_optimizer_goes_on_after_gather():
    splats, optimizer = trained()
    gather(splats, optimizer, torch.tensor([1, 2, 3]), torch.zeros(3, dtype=torch.bool))
    before = splats.means.detach().clone()
    splats.means.sum().backward()
    optimizer.step()
    assert not torch.equal(before, splats.means)


def test_state_dict_of_another_size_loads():
    big, small = Splats(random_gaussians(9)), Splats(random_gaussians(2))
    small.load_state_dict(big.state_dict())
    assert len(small) == 9 and torch.equal(small.means, big.means)


def test_wrong_row_count_is_told():
    with pytest.raises(ValueError, match="'psi' has 3 rows, expected 2"):
        Splats(random_gaussians(2), extra={"psi": torch.zeros(3, 4)})


def test_densify_prunes_faint_and_copies_the_needy():
    splats, optimizer = trained(8)
    with torch.no_grad():
        splats.opacity_logits.copy_(torch.tensor([-9.0, 1, 1, 1, 1, 1, 1, 1]))
        splats.log_scales.fill_(-3)
    splats.grad_sum.copy_(torch.tensor([9.0, 0, 0, 5, 0, 3, 0, 0]))
    splats.seen.fill_(1)
    means = splats.means.detach().clone()
    added, pruned = densify(
        splats, optimizer, 9, generator=torch.Generator().manual_seed(0), max_growth=1.0, split_scale=1.0
    )
    assert (added, pruned) == (2, 1)  # only two have a gradient; the faint one went although its gradient was largest
    assert torch.allclose(splats.means[:7], means[1:], atol=1e-6)
    assert (splats.means[7] - means[3]).norm() < 0.2 and (splats.means[8] - means[5]).norm() < 0.2
    # a clone shares its opacity: 1 - (1-a)^2 = the old one
    a = torch.sigmoid(splats.opacity_logits[7])
    assert torch.allclose(1 - (1 - a) ** 2, torch.sigmoid(torch.tensor(1.0)), atol=1e-3)
    assert splats.grad_sum.abs().sum() == 0


def test_densify_keeps_to_its_target_and_is_deterministic():
    results = []
    for _ in range(2):
        splats, optimizer = trained(50)
        splats.grad_sum.copy_(torch.rand(50, generator=torch.Generator().manual_seed(3)))
        splats.seen.fill_(1)
        densify(splats, optimizer, 53, generator=torch.Generator().manual_seed(0), split_scale=0.0, max_scale=9.0)
        results.append(splats.means.detach().clone())
        assert len(splats) == 53
    assert torch.equal(*results)


def test_growth_by_threshold_takes_what_exceeds_it_and_needs_no_budget():
    splats, optimizer = trained(8)
    splats.opacity_logits.data.fill_(2.0)
    splats.grad_sum, splats.seen = torch.tensor([8.0, 0, 3, 0, 0, 6, 0, 0]), torch.full((8,), 2.0)
    added, pruned = densify(
        splats, optimizer, None, threshold=0.9, max_scale=9.0, generator=torch.Generator().manual_seed(0)
    )
    # means 4 and 3 per image height are 2 and 1.5 per half of it; 1.5 is 0.75
    assert (added, pruned, len(splats)) == (2, 0, 10)
    with pytest.raises(ValueError, match="target or a threshold"):
        densify(splats, optimizer, None, generator=torch.Generator())
    with pytest.raises(UserError, match="threshold above 0"):
        Densify(budget=None)


def test_opacities_are_reset_with_their_moments():
    splats, optimizer = trained()
    splats.opacity_logits.data.copy_(torch.linspace(-8, 8, 6))
    reset_opacity(splats, optimizer, 0.01)
    assert (
        torch.sigmoid(splats.opacity_logits).max().item() == pytest.approx(0.01)
        and splats.opacity_logits[0].item() == -8
    )
    state = optimizer.state[splats.opacity_logits]
    assert (
        not state["exp_avg"].any() and not state["exp_avg_sq"].any() and optimizer.state[splats.means]["exp_avg"].any()
    )
