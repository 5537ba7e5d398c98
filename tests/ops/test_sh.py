import numpy as np
import pytest
import torch
from scipy import special
from torch.autograd import gradcheck

from p2gs.ops import sh, so3

F64 = torch.float64


def unit(n, seed=0):
    v = torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=F64)
    return v / v.norm(dim=-1, keepdim=True)


def complex_harmonic(band, m, polar, azimuth):
    if hasattr(special, "sph_harm_y"):
        return special.sph_harm_y(band, m, polar, azimuth)
    return special.sph_harm(m, band, azimuth, polar)


def basis_naive(degree, directions):
    """Real harmonics from scipy's complex ones (which carry the Condon-Shortley phase): sqrt(2) Im for m < 0, sqrt(2)
    Re for m > 0."""
    x, y, z = directions.numpy().T
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    out = []
    for band in range(degree + 1):
        for m in range(-band, band + 1):
            Y = complex_harmonic(band, abs(m), polar, azimuth)
            out.append(Y.real if m == 0 else np.sqrt(2) * (Y.real if m > 0 else Y.imag))
    return torch.from_numpy(np.stack(out, -1))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_basis_agrees_with_scipy(degree):
    d = unit(200)
    torch.testing.assert_close(sh.basis(degree, d), basis_naive(degree, d))
    assert sh.basis(degree, d).shape[-1] == sh.num_bases(degree)
    assert sh.degree_of(sh.num_bases(degree)) == degree


def test_first_bands_have_the_signs_of_3dgs_files():
    Y = sh.basis(1, torch.eye(3, dtype=F64))
    c = 0.4886025119029199
    torch.testing.assert_close(Y[:, 1:], torch.tensor([[0, 0, -c], [-c, 0, 0], [0, c, 0]], dtype=F64))
    assert sh.C0 == pytest.approx(0.28209479177387814)


def test_evaluate_and_colour_round_trip():
    rgb = torch.rand(5, 3)
    torch.testing.assert_close(sh.dc_to_rgb(sh.rgb_to_dc(rgb)), rgb)
    coefficients = torch.zeros(5, 16, 3)
    coefficients[:, 0] = sh.rgb_to_dc(rgb)
    torch.testing.assert_close(sh.evaluate(coefficients, unit(5).float()), rgb)
    coefficients[:, 1:] = torch.randn(5, 15, 3)
    d = unit(5).float()
    torch.testing.assert_close(sh.evaluate(coefficients, d, degree=1), sh.evaluate(coefficients[:, :4], d))
    slow = torch.stack(
        [
            0.5 + sum(basis_naive(3, d[n : n + 1].double())[0, b] * coefficients[n, b].double() for b in range(16))
            for n in range(5)
        ]
    )
    torch.testing.assert_close(sh.evaluate(coefficients.double(), d.double()), slow, atol=1e-6, rtol=0)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rotation_turns_the_function(degree):
    g = torch.Generator().manual_seed(degree)
    c = torch.randn(10, sh.num_bases(degree), 3, generator=g, dtype=F64)
    R = so3.rotvec_to_matrix(2 * torch.randn(10, 3, generator=g, dtype=F64))
    turned = sh.rotate_sh(c, R)
    for d in unit(5, seed=9):
        torch.testing.assert_close(sh.evaluate(turned, (R @ d)), sh.evaluate(c, d.expand(10, 3)), atol=1e-11, rtol=0)


def test_rotation_is_a_representation_and_orthogonal():
    A, B = so3.rotvec_to_matrix(torch.randn(2, 3, dtype=F64))
    for Ma, Mb, Mab in zip(
        sh.rotation_matrices(A, 3), sh.rotation_matrices(B, 3), sh.rotation_matrices(A @ B, 3), strict=True
    ):
        torch.testing.assert_close(Ma @ Mb, Mab)
        torch.testing.assert_close(Ma @ Ma.T, torch.eye(len(Ma), dtype=F64), atol=1e-12, rtol=0)


def test_rotation_by_part_index_equals_rotation_one_by_one():
    c = torch.randn(20, 16, 3)
    R = so3.rotvec_to_matrix(torch.randn(3, 3))
    index = torch.randint(0, 3, (20,))
    torch.testing.assert_close(
        sh.rotate_sh(c, R, index), torch.stack([sh.rotate_sh(c[n], R[index[n]]) for n in range(20)])
    )
    torch.testing.assert_close(sh.rotate_sh(c, torch.eye(3)), c, atol=1e-5, rtol=1e-5)


def test_gradients_and_wrong_sizes():
    c = torch.randn(2, 16, 3, dtype=F64, requires_grad=True)
    w = torch.randn(2, 3, dtype=F64, requires_grad=True)
    assert gradcheck(lambda c, w: sh.rotate_sh(c, so3.rotvec_to_matrix(w)), (c, w))
    with pytest.raises(ValueError, match="12 spherical"):
        sh.degree_of(12)
    with pytest.raises(ValueError, match="degree 4"):
        sh.basis(4, torch.zeros(3))
