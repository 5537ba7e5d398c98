"""Depth along rays by all photographs: the kernel, its twin in torch, and a wall whose place is known."""

import pytest
import torch

from p2gs.ops.sweep import Pictures, agreement, agreement_reference

SIZE = 24


def random_rays(seed: int, views: int = 7, count: int = 75, steps: int = 21) -> tuple:
    """Pictures of noise, one of them smaller, and rays some of whose points lie behind cameras or beside pictures."""
    g = torch.Generator().manual_seed(seed)
    pixels = torch.rand(views, 20, 30, 4, generator=g)
    sizes = torch.tensor([[30.0, 20.0]] * (views - 1) + [[24.0, 16.0]])
    lines = 5 * torch.randn(views, 3, 4, generator=g)
    lines[:, 2] = 0.3 * torch.randn(views, 4, generator=g)
    lines[:, :, 3] = torch.tensor([30.0, 30.0, 2.0])
    origins, ways = torch.randn(2, count, 3, generator=g)
    colours = pixels[0].reshape(-1, 4)[torch.randint(600, (count,), generator=g)]
    return Pictures(pixels, sizes, lines), 0.3 * origins, ways, colours, torch.linspace(0, 2, steps), 0.7


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("count, steps", [(75, 21), (1, 1), (33, 16), (0, 3)])
def test_the_kernel_does_what_torch_does(seed, count, steps):
    given = random_rays(seed, count=count, steps=steps)
    exact = (Pictures(*(t.double() for t in given[0])), *(t.double() for t in given[1:5]), given[5])
    out = agreement(*given)
    assert out.shape == (count, steps)
    torch.testing.assert_close(out.double(), agreement_reference(*exact), atol=1e-5, rtol=0)


def wall(cameras: int, hidden: int = 0) -> tuple:
    """Photographs of the plane z = 0, coloured by place, from above; ``hidden`` of them show something black."""
    line = torch.tensor([[20.0, 0, SIZE / 2, 0], [0, 20.0, SIZE / 2, 0], [0, 0, 1, 0]])
    lines, pixels = [], []
    y, x = torch.meshgrid(*[torch.arange(SIZE) + 0.5 - SIZE / 2] * 2, indexing="ij")
    for c in range(cameras):
        eye = torch.tensor([0.3 * torch.tensor(2.4 * c).cos(), 0.3 * torch.tensor(2.4 * c).sin(), -2.0 - 0.05 * c])
        pose = torch.eye(4)
        pose[:3, 3] = -eye
        lines.append(line @ pose)
        at = eye[:2] - eye[2] * torch.stack([x, y], -1) / 20
        shade = torch.stack([(5 * at[..., 0]).sin(), (4 * at[..., 1]).cos(), (3 * at.sum(-1)).sin()], -1) / 2 + 0.5
        pixels.append(torch.cat([shade, torch.ones(SIZE, SIZE, 1)], -1) * (c >= hidden or c == 0))
    pictures = Pictures(torch.stack(pixels), torch.full((cameras, 2), float(SIZE)), torch.stack(lines))
    return pictures, torch.tensor([0.3, 0, -2.0])


def rays_at_the_wall(pictures: Pictures, eye: torch.Tensor) -> tuple:
    rows, cols = torch.meshgrid(torch.arange(4, SIZE - 4), torch.arange(4, SIZE - 4), indexing="ij")
    ways = torch.stack([(cols + 0.5 - SIZE / 2) / 20, (rows + 0.5 - SIZE / 2) / 20, torch.ones_like(rows)], -1)
    colours = pictures.pixels[0, rows, cols].reshape(-1, 4)
    return eye.expand(len(colours), 3), ways.reshape(-1, 3).float(), colours


@pytest.mark.parametrize("hidden", [0, 6])
def test_rays_end_at_the_wall_also_where_half_of_the_photographs_do_not_show_it(hidden):
    pictures, eye = wall(12, hidden)
    depths = torch.linspace(1.0, 3.0, 41)
    most, index = agreement(pictures, *rays_at_the_wall(pictures, eye), depths, 0.1).max(1)
    assert float((depths[index] - 2).abs().le(0.051).float().mean()) > 0.97
    assert float(most.median()) > 0.75 - hidden / 12


def test_the_order_of_the_photographs_does_not_matter():
    pictures, eye = wall(12)
    rays, depths = rays_at_the_wall(pictures, eye), torch.linspace(1.0, 3.0, 41)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(3))
    one, two = (agreement(p, *rays, depths, 0.1) for p in (pictures, Pictures(*(t[order] for t in pictures))))
    torch.testing.assert_close(one, two, atol=1e-5, rtol=0)


def test_nothing_is_agreed_on_where_no_photograph_looks():
    pictures, eye = wall(3)
    behind = torch.tensor([[0.0, 0.0, -1.0]])
    assert not agreement(pictures, eye[None], behind, torch.zeros(1, 4), torch.linspace(1, 2, 5), 0.1).any()


def test_shapes_that_do_not_belong_together_are_said():
    pictures, *rest = random_rays(0)
    with pytest.raises(ValueError, match=r"sizes \[V, 2\]"):
        agreement(pictures._replace(sizes=pictures.sizes[:2]), *rest)
    with pytest.raises(ValueError, match=r"colours \[N, 4\]"):
        agreement(pictures, rest[0][:3], *rest[1:])
