"""A two-state scene of a few hundred Gaussians, photographed by the rasterizer itself; small enough for unit tests."""

import torch

from p2gs.data.base import TwoStateData, Visit
from p2gs.motion.screw_polish import MovedGaussians
from p2gs.ops import se3
from p2gs.render import rasterize
from p2gs.types import Camera, GaussianTensors, TwoStateScene, View


class TinyData(TwoStateData):
    """A phase's views are its own; this says which of them a step looks at."""

    def __init__(self):
        super().__init__("")

    def setup(self, stage=None):
        pass


def visit(phase, step: int = 0) -> Visit:
    """What the phase looks at in a step."""
    return TinyData().visits(phase.views, phase.seed)[step]


def random_gaussians(n: int, seed: int = 0, degree: int = 1) -> GaussianTensors:
    g = torch.Generator().manual_seed(seed)
    sh = 0.3 * torch.randn(n, (degree + 1) ** 2, 3, generator=g)
    quats = torch.randn(n, 4, generator=g)
    return GaussianTensors(
        torch.randn(n, 3, generator=g),
        quats,
        -3 + 0.2 * torch.randn(n, 3, generator=g),
        torch.randn(n, generator=g),
        sh,
    )


def textured_panels(n: int = 600) -> tuple[GaussianTensors, torch.Tensor]:
    """A static (label 0) and a moving (label 1) panel of coloured, opaque Gaussians."""
    gen = torch.Generator().manual_seed(4)
    points = torch.rand(n, 3, generator=gen) * torch.tensor([0.8, 0.06, 0.8]) - torch.tensor([0.4, 0.03, 0.4])
    labels = (torch.arange(n) % 2).long()
    points[labels == 1] += torch.tensor([0.0, 0.5, 0.0])
    sh = torch.rand(n, 1, 3, generator=gen) * 3 - 1.5
    return GaussianTensors(
        points, random_gaussians(n, 4).quats, torch.full((n, 3), -3.2), torch.full((n,), 3.0), sh
    ), labels


def hinge() -> torch.Tensor:
    return se3.from_screw(torch.tensor([0.0, 0.1, 1]).double(), torch.tensor([0.4, 0.5, 0]).double(), 0.5)


def slide() -> torch.Tensor:
    T = torch.eye(4).double()
    T[:3, 3] = torch.tensor([0.3, 0.0, 0.1])
    return T


def look_at(eye: torch.Tensor, size: int) -> Camera:
    forward = -eye / eye.norm()
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0, 1])), dim=0)
    R = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat = torch.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = R, -R @ eye
    K = torch.tensor([[size * 1.4, 0, size / 2], [0, size * 1.4, size / 2], [0, 0, 1.0]])
    return Camera(viewmat, K, size, size)


def photographs(
    g: GaussianTensors, labels: torch.Tensor, transform: torch.Tensor, state: int, size: int = 64, count: int = 8
) -> list[View]:
    """Views on a ring of the panels with part 1 moved by ``transform`` [4, 4], or every part by its own, [K, 4, 4]."""
    body = MovedGaussians(g, labels)
    means, quats, sh = body.moved(transform.reshape(-1, 4, 4))
    views = []
    for k in range(count):
        angle = torch.tensor(k * 2 * torch.pi / count)
        camera = look_at(torch.stack([3 * angle.cos(), 3 * angle.sin(), torch.tensor(1.0)]), size)
        out = rasterize(means, quats, body.scales, body.opacities, sh, camera.viewmat, camera.K, size, size)
        colour = (out.colour / out.alpha.clamp_min(1e-3)[..., None]).clamp(0, 1)
        views.append(
            View(
                f"{state}_{k}", state, "train", camera, (colour * 255).round().byte(), (out.alpha * 255).round().byte()
            )
        )
    return views


def tiny_scene(transform: torch.Tensor, size: int = 48) -> TwoStateScene:
    g, labels = textured_panels()
    views = photographs(g, labels, torch.eye(4).double(), 0, size) + photographs(g, labels, transform, 1, size)
    return TwoStateScene("tiny", tuple(views), box=torch.tensor([[-0.6, -0.2, -0.6], [0.9, 0.9, 0.7]]))
