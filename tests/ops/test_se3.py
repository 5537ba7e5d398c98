import math

import pytest
import torch
from torch.autograd import gradcheck

from p2gs.ops import se3

F64 = torch.float64


def twists(n=100, seed=0, dtype=F64):
    g = torch.Generator().manual_seed(seed)
    xi = torch.randn(n, 6, generator=g, dtype=F64)
    angle = torch.rand(n, 1, generator=g, dtype=F64) * 3.1
    angle[:6, 0] = torch.tensor([0.0, 1e-9, 1e-4, 0.4999, 0.5001, 3.1], dtype=F64)
    xi[:, :3] *= angle / xi[:, :3].norm(dim=-1, keepdim=True)
    return xi.to(dtype)


def exp_naive(xi):
    """The matrix exponential of the 4x4 twist, by its definition."""
    out = []
    for x in xi:
        M = torch.zeros(4, 4, dtype=xi.dtype)
        M[:3, :3] = torch.stack([torch.linalg.cross(x[:3], e) for e in torch.eye(3, dtype=xi.dtype)], 1)
        M[:3, 3] = x[3:]
        out.append(torch.linalg.matrix_exp(M))
    return torch.stack(out)


def test_exp_is_the_matrix_exponential_and_log_inverts_it():
    xi = twists()
    torch.testing.assert_close(se3.exp(xi), exp_naive(xi), atol=1e-12, rtol=0)
    torch.testing.assert_close(se3.log(se3.exp(xi)), xi, atol=1e-10, rtol=0)
    torch.testing.assert_close(se3.exp(xi.float()).double(), exp_naive(xi), atol=5e-6, rtol=0)
    assert (se3.exp(xi.view(5, 20, 6)) == se3.exp(xi).view(5, 20, 4, 4)).all()


def test_adjoint_takes_a_twist_to_the_other_side():
    T, xi = se3.exp(twists()), twists().flip(0)
    moved = se3.exp((se3.adjoint(T) @ xi[..., None])[..., 0]) @ T
    torch.testing.assert_close(T @ se3.exp(xi), moved, atol=1e-10, rtol=0)


def test_inverse_and_apply():
    T = se3.exp(twists())
    torch.testing.assert_close(se3.inverse(T) @ T, torch.eye(4, dtype=F64).expand_as(T), atol=1e-12, rtol=0)
    points = torch.randn(7, 3, dtype=F64)
    homogeneous = torch.cat([points, torch.ones(7, 1, dtype=F64)], -1)
    expected = torch.stack([torch.stack([(t @ h)[:3] for h in homogeneous]) for t in T])
    torch.testing.assert_close(se3.apply(T, points), expected)


def test_screw_at_is_a_one_parameter_group():
    xi = twists(seed=1)
    T = se3.exp(xi)
    half = se3.screw_at(T, 0.5)
    torch.testing.assert_close(half @ half, T, atol=1e-10, rtol=0)
    torch.testing.assert_close(se3.screw_at(T, -1.0), se3.inverse(T), atol=1e-10, rtol=0)
    torch.testing.assert_close(se3.screw_at(xi, 1.0), T)
    s = torch.tensor([[0.0], [0.25]], dtype=F64)
    both = se3.screw_at(xi, s)
    assert both.shape == (2, 100, 4, 4)
    torch.testing.assert_close(both[1], se3.exp(xi * 0.25))


def test_screw_parameters_agree_with_the_pseudo_inverse_and_round_trip():
    T = se3.exp(twists(seed=2))[2:]
    screw = se3.screw_parameters(T)
    torch.testing.assert_close(se3.from_screw(*screw), T, atol=1e-9, rtol=0)
    for k in range(4, len(T)):
        R, t, axis = T[k, :3, :3], T[k, :3, 3], screw.axis[k]
        origin = torch.linalg.pinv(torch.eye(3, dtype=F64) - R, rtol=1e-9) @ t
        torch.testing.assert_close(screw.origin[k], origin - axis * axis.dot(origin), atol=1e-8, rtol=0)
    assert (screw.origin * screw.axis).sum(-1).abs().max() < 1e-6


def test_screw_parameters_of_a_hinge_and_of_a_slide():
    axis, origin = torch.tensor([0.0, 0.6, 0.8]), torch.tensor([1.0, 2.0, 3.0])
    hinge = se3.from_screw(axis, origin, math.radians(60))
    got = se3.screw_parameters(hinge)
    torch.testing.assert_close(got.axis, axis)
    assert torch.linalg.cross(got.origin - origin, axis).norm() < 1e-5
    assert abs(got.angle.item() - math.pi / 3) < 1e-6
    assert abs(got.translation.item()) < 1e-5
    slide = se3.screw_parameters(se3.from_screw(axis, origin, 0.0, -0.3))
    torch.testing.assert_close(slide.axis, -axis)
    assert slide.angle == 0
    assert abs(slide.translation.item() - 0.3) < 1e-6
    still = se3.screw_parameters(torch.eye(4))
    assert torch.isfinite(torch.cat([still.axis, still.origin])).all()
    assert still.translation == 0


def test_projections_are_idempotent_and_say_what_they_say():
    xi = twists(seed=3)[2:]
    T = se3.exp(xi)
    hinge = se3.project_revolute(T)
    assert se3.screw_parameters(hinge).translation.abs().max() < 1e-9
    torch.testing.assert_close(hinge[:, :3, :3], T[:, :3, :3])
    torch.testing.assert_close(se3.project_revolute(hinge), hinge)
    torch.testing.assert_close(se3.exp(se3.project_revolute(xi)), hinge, atol=1e-9, rtol=0)
    axis, origin, *_ = se3.screw_parameters(T)
    axis_h, origin_h, *_ = se3.screw_parameters(hinge)
    torch.testing.assert_close(torch.cat([axis_h, origin_h]), torch.cat([axis, origin]), atol=1e-7, rtol=0)

    center = torch.randn(len(T), 3, dtype=F64)
    slide = se3.project_prismatic(T, center)
    torch.testing.assert_close(se3.apply(slide, center[:, None]), se3.apply(T, center[:, None]))
    torch.testing.assert_close(slide[:, :3, :3], torch.eye(3, dtype=F64).expand(len(T), 3, 3))
    torch.testing.assert_close(se3.exp(se3.project_prismatic(xi, center)), slide)
    pure = torch.tensor([0, 0, 0, 1.0, 2.0, 3.0])
    torch.testing.assert_close(se3.project_revolute(pure), pure)


def test_gradients_against_finite_differences():
    xi = twists(6, seed=4).requires_grad_()
    assert gradcheck(se3.exp, xi)
    assert gradcheck(lambda x: se3.log(se3.exp(x)), xi)
    assert gradcheck(lambda x: se3.screw_at(se3.exp(x), 0.3), xi)
    turning = twists(9, seed=4)[6:].requires_grad_()
    assert gradcheck(lambda x: tuple(se3.screw_parameters(se3.exp(x))), turning)
    assert gradcheck(lambda x: se3.project_revolute(se3.exp(x)), turning)


@pytest.mark.parametrize("angle", [0.0, 1e-20, math.pi])
def test_gradients_are_finite_at_the_special_angles(angle):
    xi = torch.tensor([angle, 0, 0, 0.1, 0.2, 0.3], requires_grad=True)
    T = se3.exp(xi)
    total = se3.log(T).sum() + sum(p.sum() for p in se3.screw_parameters(T)) + se3.screw_at(T, 0.5).sum()
    (grad,) = torch.autograd.grad(total, xi)
    assert torch.isfinite(grad).all()


def test_distances_and_orientation_are_kept():
    T = se3.exp(twists(10, seed=6))
    points = torch.randn(300, 3, dtype=F64)
    moved = se3.apply(T, points)
    torch.testing.assert_close(
        (moved[:, 1:] - moved[:, :-1]).norm(dim=-1), (points[1:] - points[:-1]).norm(dim=-1).expand(10, -1)
    )
    torch.testing.assert_close(torch.linalg.det(T[:, :3, :3]), torch.ones(10, dtype=F64))


def test_the_mean_gap_is_that_of_the_points_one_by_one():
    *many, one = se3.exp(twists(9, seed=7))
    points = torch.randn(5, 3, generator=torch.Generator().manual_seed(8), dtype=F64)
    naive = [sum(math.dist(T[:3, :3] @ p + T[:3, 3], one[:3, :3] @ p + one[:3, 3]) for p in points) / 5 for T in many]
    torch.testing.assert_close(se3.mean_gap(torch.stack(many), one, points), torch.tensor(naive, dtype=F64))
    assert float(se3.mean_gap(one, one, points)) == 0 and torch.isnan(se3.mean_gap(one, one, points[:0]))
