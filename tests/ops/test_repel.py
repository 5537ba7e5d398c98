import functools
import math

import pytest
import torch
from torch.autograd import gradcheck

from p2gs.models.repel import place_repel_points
from p2gs.ops import so3
from p2gs.ops.repel import repel_force

F64 = torch.float64


def cloud(n, seed=0, scale=1.0):
    return scale * torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=F64)


def repel_naive(points, repel_points, k_r, exponent, eps, reduce, tau_max, radius):
    """Equation repel_clamped, pair by pair."""
    out = []
    for x in points.tolist():
        total, count = [0.0] * 3, 0
        for r in repel_points.tolist():
            offset = [b - a for a, b in zip(x, r, strict=True)]
            distance = math.sqrt(sum(o * o for o in offset))
            if reduce in ("local", "within") and distance >= radius:
                continue
            count += 1
            total = [t + k_r * o / max(distance, eps) ** exponent for t, o in zip(total, offset, strict=True)]
        if reduce in ("mean", "local") and count:
            total = [t / count for t in total]
        length = math.sqrt(sum(t * t for t in total))
        out.append([t * min(1.0, tau_max / length) if length else t for t in total])
    return torch.tensor(out, dtype=F64)


@pytest.mark.parametrize("reduce", ["sum", "mean", "local", "within"])
@pytest.mark.parametrize("exponent", [2, 3, 4])
def test_force_agrees_with_the_equation(reduce, exponent):
    x, r = cloud(30, 1), cloud(17, 2)
    x[0] = r[0]  # distance zero: the floor holds
    arguments = dict(k_r=0.3, exponent=exponent, eps=1e-2, reduce=reduce, tau_max=1.5, radius=0.8)
    torch.testing.assert_close(repel_force(x, r, **arguments, chunk=40), repel_naive(x, r, **arguments))


def test_sparse_and_dense_local_force_are_one():
    from p2gs.ops.repel import _dense, _sparse

    x, r = cloud(300, 3), cloud(200, 4)
    for reduce in ("local", "within"):
        torch.testing.assert_close(_sparse(x, r, 3, 1e-5, 0.4, reduce), _dense(x, r, 3, 1e-5, reduce, 0.4))


@pytest.mark.parametrize("reduce", ["local", "within", "mean", "sum"])
@pytest.mark.parametrize("exponent", [2, 3, 4.5])
@pytest.mark.parametrize("sizes", [(1, 1), (5, 17), (300, 33), (65, 700)])
def test_native_force_and_its_gradient(isa, threads, reduce, exponent, sizes):
    x, r = cloud(sizes[0], 3), cloud(sizes[1], 4)
    x[0] = r[0]  # in the sphere where the floor holds
    arguments = dict(k_r=0.3, exponent=exponent, eps=0.05, reduce=reduce, tau_max=2.0, radius=0.7)
    direction = cloud(sizes[0], 5)
    ours, exact = x.float().requires_grad_(), x.requires_grad_()
    force, expected = repel_force(ours, r.float(), **arguments), repel_force(exact, r, **arguments)
    torch.testing.assert_close(force.double(), expected, rtol=1e-4, atol=1e-5)
    (grad,) = torch.autograd.grad(force, ours, direction.float())
    (expected,) = torch.autograd.grad(expected, exact, direction)
    assert (grad - expected).norm() <= 1e-4 * expected.norm() + 1e-6


def test_native_local_force_has_the_same_bits_for_any_number_of_threads(isa):
    x, r, forces = cloud(999, 3).float(), cloud(500, 4).float(), []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        forces.append(repel_force(x, r, reduce="local", radius=0.5))
    assert forces[0].any() and all(torch.equal(f, forces[0]) for f in forces)


def test_force_turns_with_the_scene_and_does_not_see_translation():
    x, r = cloud(20, 5), cloud(30, 6)
    R, t = so3.rotvec_to_matrix(torch.tensor([0.4, -1.0, 2.0], dtype=F64)), torch.tensor([3.0, -1.0, 2.0], dtype=F64)
    for reduce in ("sum", "mean", "local", "within"):
        force = repel_force(x, r, reduce=reduce, radius=1.0)
        torch.testing.assert_close(repel_force(x @ R.T + t, r @ R.T + t, reduce=reduce, radius=1.0), force @ R.T)
        twice = repel_force(x, torch.cat([r, r]), reduce=reduce, radius=1.0)
        torch.testing.assert_close(twice, force * (2 if reduce in ("sum", "within") else 1))


@pytest.mark.parametrize("reduce", ["sum", "mean", "local", "within"])
def test_gradients(reduce):
    x, r = cloud(4, 7).requires_grad_(), cloud(5, 8).requires_grad_()
    for tau_max in (None, 0.2):
        options = {"k_r": 0.1, "reduce": reduce, "radius": 1.5, "tau_max": tau_max, "eps": 0.01}
        assert gradcheck(functools.partial(repel_force, **options), (x, r))
    same = torch.zeros(1, 3, requires_grad=True)
    repel_force(same, same.detach(), reduce=reduce, radius=1.0, tau_max=0.1).sum().backward()
    assert torch.isfinite(same.grad).all()


def test_empty_sets_and_missing_radius():
    assert repel_force(torch.zeros(0, 3), torch.zeros(5, 3)).shape == (0, 3)
    assert (repel_force(torch.zeros(5, 3), torch.zeros(0, 3)) == 0).all()
    with pytest.raises(ValueError, match="radius"):
        repel_force(torch.zeros(5, 3), torch.zeros(1, 3), reduce="local")


def test_points_are_placed_on_the_static_side_of_the_interface():
    x = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0))
    static, movable = x[:2000], x[2000:] + torch.tensor([1.0, 0, 0])
    placed = place_repel_points(static, movable, 100, 0.1, "absolute", generator=torch.Generator().manual_seed(1))
    assert placed.shape == (100, 3)
    assert len(torch.unique(placed, dim=0)) == 100
    assert all((static == p).all(-1).any() for p in placed)
    assert placed[:, 0].min() > 0.9
    near = torch.cdist(static, movable).amin(1)
    for mode, threshold, length in [
        ("absolute", 0.1, 0.1),
        ("relative", 0.05, 0.05 * (x.new_tensor([2, 1, 1])).norm().item()),
        ("spacing", 2.0, 2 * torch.cdist(static, static).fill_diagonal_(9).amin(1).median().item()),
    ]:
        found = place_repel_points(static, movable, 10**6, threshold, mode)
        assert abs(len(found) - (near < length).sum().item()) <= 3  # the cloud fills its box to within a point or two
    # the paper's number selects nearly everything
    assert len(place_repel_points(static, movable, 10**6, 1.5, "absolute")) > 1900


def test_placement_is_reproducible_and_noise_has_its_size():
    static, movable = cloud(3000, 1).float(), cloud(3000, 2).float()

    def draw(noise):
        generator = torch.Generator().manual_seed(3)
        return place_repel_points(static, movable, 1500, 0.2, noise=noise, generator=generator)

    assert (draw(0.0) == draw(0.0)).all()
    # a length, not a spread per axis
    torch.testing.assert_close((draw(0.05) - draw(0.0)).norm(dim=1), torch.full((1500,), 0.05))
    assert (draw(0.05) - draw(0.0)).mean(0).norm() < 0.005
    half = place_repel_points(static, movable, 10**6, 0.2, extent=0.5)
    assert len(half) == len(place_repel_points(static, movable, 10**6, 0.1, "absolute"))
    assert len(place_repel_points(static, movable[:0])) == 0
    assert len(place_repel_points(static, movable + 1e3, mode="absolute")) == 0
    with pytest.raises(ValueError, match="threshold mode"):
        place_repel_points(static, movable, mode="inches")
