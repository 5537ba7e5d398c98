"""Who is seen by some view, and who hangs in front of what the other state sees."""

import pytest
import torch
from tiny import look_at

from p2gs.render import rasterize
from p2gs.render.base import PIXELS
from p2gs.types import GaussianTensors
from p2gs.visibility.share import footprint, visible_share


def gaussians(means, scales, opacity):
    n = len(means)
    quats = torch.zeros(n, 4)
    quats[:, 0] = 1
    log_scales = torch.as_tensor(scales).log()[:, None].expand(n, 3).clone()
    return GaussianTensors(means, quats, log_scales, torch.logit(torch.full((n,), opacity)), torch.zeros(n, 1, 3))


def ring(size=64, count=6):
    angle = torch.arange(count) * 2 * torch.pi / count
    return [look_at(torch.stack([3 * a.cos(), 3 * a.sin(), torch.tensor(1.0)]), size) for a in angle]


@pytest.mark.parametrize("pixels", PIXELS)
def test_footprint_is_what_one_gaussian_adds_to_alpha(pixels):
    g = gaussians(torch.tensor([[0.1, -0.2, 0.1]]), torch.tensor([0.08]), 0.7)
    for camera in ring():
        activated = (g.means, g.quats, g.log_scales.exp(), torch.sigmoid(g.opacity_logits), g.sh)
        out = rasterize(*activated, camera.viewmat, camera.K, 64, 64, backend=f"auto:{pixels}")
        assert float(footprint(g, camera, PIXELS[pixels])[0]) == pytest.approx(float(out.alpha.sum()), rel=0.03)


def test_what_a_shell_encloses_is_hidden_and_the_shell_is_not():
    torch.manual_seed(0)
    shell = torch.nn.functional.normalize(torch.randn(6000, 3), dim=1)
    core = 0.3 * torch.randn(50, 3).clamp(-1, 1)
    g = gaussians(torch.cat([shell, core]), torch.full((6050,), 0.05), 0.98)
    share = visible_share(g, ring())
    assert float(share[6000:].max()) < 0.02
    # overlaps hide much, and the ring of cameras does not see the south
    assert float((share[:6000] > 0.1).float().mean()) > 0.3
    lone = visible_share(g[torch.tensor([6000])], ring())
    assert float(lone) == pytest.approx(1.0, abs=0.05)
