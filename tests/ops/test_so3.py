import math

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.autograd import gradcheck

from p2gs.ops import so3

F64 = torch.float64


def random_rotvecs(n=200, seed=0):
    """Rotation vectors with angles from 0 through tiny and ordinary to exactly pi."""
    g = torch.Generator().manual_seed(seed)
    axis = torch.randn(n, 3, generator=g, dtype=F64)
    axis /= axis.norm(dim=-1, keepdim=True)
    angle = torch.rand(n, 1, generator=g, dtype=F64) * math.pi
    angle[:8, 0] = torch.tensor([0.0, 1e-9, 1e-5, 1e-3, 0.4999, 0.5001, math.pi - 1e-6, math.pi], dtype=F64)
    return axis * angle


@pytest.mark.parametrize(("dtype", "tol"), [(torch.float32, 3e-6), (F64, 1e-12)])
def test_exp_agrees_with_scipy(dtype, tol):
    w = random_rotvecs()
    expected = torch.from_numpy(Rotation.from_rotvec(w.numpy()).as_matrix())
    torch.testing.assert_close(so3.rotvec_to_matrix(w.to(dtype)).to(F64), expected, atol=tol, rtol=0)


@pytest.mark.parametrize(("dtype", "tol"), [(torch.float32, 2e-3), (F64, 1e-7)])
def test_log_inverts_exp_up_to_the_sign_at_pi(dtype, tol):
    w = random_rotvecs()[1:].to(dtype)
    back = so3.matrix_to_rotvec(so3.rotvec_to_matrix(w))
    error = torch.minimum(
        (back - w).norm(dim=-1), (back - w * (1 - 2 * math.pi / w.norm(dim=-1, keepdim=True))).norm(dim=-1)
    )
    assert error.max() < tol
    assert error.median() < tol * 1e-3


def test_quaternions_agree_with_scipy():
    g = torch.Generator().manual_seed(1)
    a, b = torch.randn(2, 5, 40, 4, generator=g, dtype=F64)
    ra, rb = (Rotation.from_quat(q.flatten(0, 1).numpy(), scalar_first=True) for q in (a, b))
    torch.testing.assert_close(so3.quat_to_matrix(a).flatten(0, 1), torch.from_numpy(ra.as_matrix()))
    product = so3.quat_to_matrix(so3.quat_multiply(a, b)).flatten(0, 1)
    torch.testing.assert_close(product, torch.from_numpy((ra * rb).as_matrix()))
    expected = torch.from_numpy(ra.as_quat(canonical=True, scalar_first=True))
    torch.testing.assert_close(so3.matrix_to_quat(so3.quat_to_matrix(a)).flatten(0, 1), expected)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 2, 3)])
def test_matrix_to_quat_at_half_turns(axis):
    axis = torch.tensor(axis, dtype=F64)
    R = 2 * torch.outer(axis, axis) / axis.dot(axis) - torch.eye(3, dtype=F64)
    q = so3.matrix_to_quat(R)
    torch.testing.assert_close(so3.quat_to_matrix(q), R)
    torch.testing.assert_close(so3.matrix_to_rotvec(R).norm(), torch.tensor(math.pi, dtype=F64))


def test_zero_quaternion_is_the_identity_with_finite_gradient():
    q = torch.zeros(4, requires_grad=True)
    R = so3.quat_to_matrix(q)
    R.sum().backward()
    torch.testing.assert_close(R, torch.eye(3))
    assert torch.isfinite(q.grad).all()


def test_angle_agrees_with_scipy_and_is_exact_near_zero_and_pi():
    w = random_rotvecs()
    torch.testing.assert_close(so3.rotation_angle(so3.rotvec_to_matrix(w)), w.norm(dim=-1), atol=1e-12, rtol=1e-9)
    A, B = so3.rotvec_to_matrix(w[:100]), so3.rotvec_to_matrix(w[100:])
    expected = (Rotation.from_matrix(A.numpy()).inv() * Rotation.from_matrix(B.numpy())).magnitude()
    torch.testing.assert_close(so3.rotation_angle(A, B), torch.from_numpy(expected))
    # arccos of a float32 trace cannot resolve this: it gives 0 or 3.5e-4 steps
    tiny = so3.rotation_angle(so3.rotvec_to_matrix(torch.tensor([1e-5, 0.0, 0.0])))
    assert abs(tiny.item() - 1e-5) < 1e-9


def test_gradients_against_finite_differences():
    w = random_rotvecs(8, seed=2)[:6].requires_grad_()
    assert gradcheck(so3.rotvec_to_matrix, w)
    large = random_rotvecs(12, seed=3)[8:].requires_grad_()
    assert gradcheck(lambda v: so3.matrix_to_rotvec(so3.rotvec_to_matrix(v)), large)
    assert gradcheck(lambda v: so3.rotation_angle(so3.rotvec_to_matrix(v)), large)
    assert gradcheck(lambda v: so3.matrix_to_rotvec(so3.rotvec_to_matrix(v)), w)
    q = torch.randn(4, 4, dtype=F64, requires_grad=True)
    assert gradcheck(so3.quat_to_matrix, q)
    assert gradcheck(lambda p: so3.matrix_to_quat(so3.quat_to_matrix(p)), q)


@pytest.mark.parametrize("angle", [0.0, 1e-20, 1e-4, math.pi])
def test_gradients_are_finite_at_the_special_angles(angle):
    for dtype in (torch.float32, F64):
        w = torch.tensor([angle, 0, 0], dtype=dtype, requires_grad=True)
        R = so3.rotvec_to_matrix(w)
        total = so3.rotation_angle(R) + so3.matrix_to_rotvec(R).sum() + so3.matrix_to_quat(R).sum()
        (grad,) = torch.autograd.grad(total, w)
        assert torch.isfinite(grad).all()


def kabsch_naive(src, dst, weights):
    """scipy's alignment of the centred vectors, one cloud at a time."""
    w = (weights / weights.sum()).numpy()
    s, d = src.numpy(), dst.numpy()
    sm, dm = (w[:, None] * s).sum(0), (w[:, None] * d).sum(0)
    R = Rotation.align_vectors(d - dm, s - sm, weights=w)[0].as_matrix()
    return torch.from_numpy(R), torch.from_numpy(dm - R @ sm)


def test_kabsch_agrees_with_scipy_on_noisy_weighted_clouds():
    g = torch.Generator().manual_seed(4)
    src = torch.randn(50, 3, generator=g, dtype=F64)
    weights = torch.rand(3, 50, generator=g, dtype=F64)
    dst = src @ so3.rotvec_to_matrix(torch.tensor([0.3, -2.0, 1.0], dtype=F64)).T + 0.2 * torch.randn(
        50, 3, generator=g, dtype=F64
    )
    R, t = so3.kabsch(src, dst, weights)
    for k in range(3):
        R_slow, t_slow = kabsch_naive(src, dst, weights[k])
        torch.testing.assert_close(R[k], R_slow)
        torch.testing.assert_close(t[k], t_slow)


def test_kabsch_never_reflects_and_survives_degenerate_input():
    g = torch.Generator().manual_seed(5)
    src = torch.randn(20, 3, generator=g, dtype=F64)
    R, _ = so3.kabsch(src, src * torch.tensor([1.0, 1.0, -1.0], dtype=F64))
    torch.testing.assert_close(torch.linalg.det(R), torch.tensor(1.0, dtype=F64))
    flat = src * torch.tensor([1.0, 1.0, 0.0], dtype=F64)
    turn = so3.rotvec_to_matrix(torch.tensor([0.1, 0.5, -0.7], dtype=F64))
    R, t = so3.kabsch(flat, flat @ turn.T + 1.0)
    torch.testing.assert_close(R, turn)
    torch.testing.assert_close(t, torch.ones(3, dtype=F64))
    R, t = so3.kabsch(src, src + 1, torch.zeros(2, 20, dtype=F64))
    torch.testing.assert_close(R, torch.eye(3, dtype=F64).expand(2, 3, 3))
    assert (t == 0).all()
