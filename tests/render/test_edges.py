"""What must never crash, and what must be told in one sentence."""

import math
import subprocess
import sys

import pytest
import torch
from worlds import INPUTS, backward, world

from p2gs.native import native
from p2gs.render import rasterize
from p2gs.render.base import PIXELS
from p2gs.types import UserError

BACKENDS = ["torch_ref"] + (["cpu"] if native is not None else [])


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("n", [0, 1])
def test_no_and_one_gaussian(backend, n):
    w = world(n, 9, 5, features=2, background="constant")
    out, leaves = w.render(backend, torch.float32, depth_sq=True, absgrad=True)
    assert out.colour.shape == (5, 9, 3) and out.features.shape == (5, 9, 2) and out.radii.shape == (n,)
    gradients = backward(out, leaves)
    assert all(g.isfinite().all() and g.shape == leaves[k].shape for k, g in gradients.items())
    assert out.means2d_abs_grad.shape == (n,)
    if n == 0:
        assert torch.equal(out.alpha, torch.zeros(5, 9))
        assert torch.allclose(out.colour, leaves["background"].expand(5, 9, 3))


@pytest.mark.parametrize("backend", BACKENDS)
def test_pixels_by_name_are_the_options_they_stand_for(backend):
    w = world(50, 20, 16, seed=3)
    colour = {p: w.render(f"{backend}:{p}", torch.float32)[0].colour for p in PIXELS}
    for name, pixels in PIXELS.items():
        assert torch.equal(
            colour[name], w.render(backend, torch.float32, eps2d=pixels.eps2d, antialias=pixels.antialias)[0].colour
        )
    assert torch.equal(colour["classic"], w.render(backend, torch.float32)[0].colour)
    assert not torch.equal(colour["classic"], colour["sharp"])


def test_unknown_pixels_are_told_in_one_sentence():
    with pytest.raises(UserError, match="rasterizer 'auto:sharpe': unknown pixels 'sharpe'.*sharp"):
        world(1, 4, 4).render("auto:sharpe", torch.float32)


@pytest.mark.parametrize("backend", BACKENDS)
def test_one_pixel(backend):
    out, leaves = world(50, 1, 1, scale=(0.5, 1.0)).render(backend, torch.float32)
    assert out.colour.shape == (1, 1, 3) and out.alpha.item() > 0.5
    assert backward(out, leaves)["means"].isfinite().all()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", INPUTS[:6])
def test_not_finite_is_culled(isa, name, value):
    """One bad Gaussian: the image and all gradients are those without it, and its own gradient is zero."""
    w = world(60, 40, 30, features=3, seed=2)
    bad = 17
    good = {k: t[torch.arange(60) != bad] if t is not None else None for k, t in w.tensors.items()}
    w.tensors[name].view(60, -1)[bad, -1] = value
    for backend in BACKENDS:
        out, leaves = w.render(backend, torch.float32)
        assert out.radii[bad] == 0
        got = backward(out, leaves)
        alone = world(59, 40, 30)
        alone.tensors, alone.viewmat, alone.K = good, w.viewmat, w.K
        reference, others = alone.render(backend, torch.float32)
        want = backward(reference, others)
        assert torch.equal(out.colour, reference.colour)
        for k, g in got.items():
            assert (g[bad] == 0).all(), k
            assert torch.allclose(g[torch.arange(60) != bad], want[k], rtol=1e-5, atol=1e-6), k


@pytest.mark.parametrize("backend", BACKENDS)
def test_zero_quaternion_and_behind_the_camera(backend):
    w = world(20, 16, 16)
    w.tensors["quats"][3] = 0
    w.tensors["means"][4:] = -10 * w.viewmat[2, :3].double()  # camera z = -7
    out, leaves = w.render(backend, torch.float32)
    assert (out.radii[3:] == 0).all()
    assert all(g.isfinite().all() for g in backward(out, leaves).values())


@pytest.mark.parametrize("scale", [1e-12, 1e3, 1e18])
@pytest.mark.parametrize("backend", BACKENDS)
def test_absurd_scales(backend, scale):
    out, leaves = world(30, 40, 40, scale=(scale, scale)).render(backend, torch.float32)
    assert out.colour.isfinite().all()
    assert all(g.isfinite().all() for g in backward(out, leaves).values())


def test_a_million(isa):
    w = world(1, 64, 48)
    n = 1_000_000
    g = torch.Generator().manual_seed(0)
    means = torch.randn(n, 3, generator=g) * 0.5
    quats, scales, sh = torch.ones(n, 4), torch.full((n, 3), 0.01), torch.zeros(n, 1, 3)
    out = rasterize(means, quats, scales, torch.full((n,), 0.5), sh, w.viewmat, w.K, 64, 48, backend="cpu")
    assert out.colour.isfinite().all() and out.alpha.max() > 0.99


def test_other_layouts_and_dtypes():
    """float64 and strided inputs are converted; gradients come back in the caller's dtype."""
    w = world(80, seed=4)
    plain, _ = w.render("auto", torch.float32, grad=False)
    opacities, *others = (w.tensors[k] for k in ("opacities", "means", "quats", "scales", "sh"))
    strided = [t.float().transpose(0, -1).contiguous().transpose(0, -1) for t in others]
    assert not strided[0].is_contiguous()
    out = rasterize(*strided[:3], opacities, strided[3], viewmat=w.viewmat, K=w.K, width=w.width, height=w.height)
    assert torch.equal(out.colour, plain.colour)
    double, leaves = w.render("auto", torch.float64)
    assert backward(double, leaves)["means"].dtype == torch.float64


_WRONG = [
    ("means", (5, 2)), ("quats", (4, 4)), ("scales", (5,)), ("opacities", (5, 1)), ("sh", (5, 3)), ("sh", (5, 5, 3)),
    ("features", (5, 17)), ("background", (4,)), ("background", (3, 3, 3)),
]  # fmt: skip


@pytest.mark.parametrize("name, shape", _WRONG)
def test_wrong_shapes(name, shape):
    arguments = {"means": (5, 3), "quats": (5, 4), "scales": (5, 3), "opacities": (5,), "sh": (5, 4, 3)}
    tensors = {k: torch.zeros(s) for k, s in {**arguments, name: shape}.items()}
    with pytest.raises(ValueError) as error:
        rasterize(viewmat=torch.eye(4), K=torch.eye(3), width=8, height=8, **tensors)
    assert "\n" not in str(error.value)
    assert name in str(error.value) or "spherical" in str(error.value)


def test_wrong_degree_and_backend():
    w = world(5, 8, 8, bases=4)
    with pytest.raises(ValueError, match="sh_degree 2 needs 9"):
        w.render("torch_ref", torch.float32, sh_degree=2)
    with pytest.raises(UserError, match="did you mean 'gsplat'"):
        w.render("gsplatt", torch.float32)


@pytest.mark.parametrize("n, scale", [(3000, (0.02, 0.2)), (20000, (0.005, 0.03))])
def test_same_bits_for_any_number_of_threads(isa, n, scale):
    """Few Gaussians are sorted by one thread, many by several."""
    w = world(n, 131, 97, features=3, background="image", scale=scale, seed=15)
    results = []
    for count in (1, 2, 3, 7):
        torch.set_num_threads(count)
        out, leaves = w.render("cpu", torch.float32, depth_sq=True, absgrad=True)
        gradients = backward(out, leaves)
        results.append(
            [out.colour, out.depth, out.depth_sq, out.alpha, out.features, out.means2d_abs_grad, *gradients.values()]
        )
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.skipif(native is None, reason="p2gs was installed without its native kernels")
def test_several_views_before_backward():
    """Each view keeps its own working memory until its graph is gone; backward may run twice."""
    w = world(200, 40, 40, seed=16)
    alone = [backward(*w.render("cpu", torch.float32, sh_degree=d))["means"] for d in (0, 3)]
    (a, x), (b, y) = (w.render("cpu", torch.float32, sh_degree=d) for d in (0, 3))
    assert torch.equal(backward(b, y)["means"], alone[1])
    assert torch.equal(backward(a, x)["means"], alone[0])
    out, leaves = w.render("cpu", torch.float32)
    first = torch.autograd.grad(out.colour.sum(), leaves["means"], retain_graph=True)[0]
    assert torch.equal(first, torch.autograd.grad(out.colour.sum(), leaves["means"])[0])


@pytest.mark.skipif(native is None, reason="p2gs was installed without its native kernels")
def test_writing_into_an_output_is_noticed():
    out, _ = world(50, 20, 20).render("cpu", torch.float32)
    loss = out.colour.sum()
    with torch.no_grad():
        out.colour.mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_slow_reference_says_so_once():
    """Without native kernels "auto" warns, one time, with the reason."""
    code = (
        "import sys, warnings; sys.modules['p2gs._native'] = None\n"
        "import torch; from p2gs.render import rasterize\n"
        "z = torch.zeros\n"
        "with warnings.catch_warnings(record=True) as seen:\n"
        "    warnings.simplefilter('always')\n"
        "    for _ in range(2): rasterize(z(2, 3), z(2, 4), z(2, 3), z(2), z(2, 1, 3), torch.eye(4), torch.eye(3), "
        "4, 4)\n"
        "print([str(w.message) for w in seen if 'reference rasterizer' in str(w.message)])\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert run.stdout.count("reference rasterizer") == 1


def test_unknown_isa_is_told():
    run = subprocess.run(
        [sys.executable, "-c", "import p2gs.render"],
        env={"P2GS_ISA": "avx9", "PATH": ""},
        capture_output=True,
        text=True,
    )
    assert native is None or "P2GS_ISA=avx9 is not among" in run.stderr
