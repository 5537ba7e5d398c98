"""The native kernels on every instruction set against the torch reference in float64: images and gradients."""

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from worlds import assert_same_as_reference, backward, relative_error, world

from p2gs.native import native


@pytest.mark.parametrize("bases", [1, 4, 9, 16])
def test_spherical_harmonics(isa, bases):
    assert_same_as_reference(world(bases=bases, seed=bases), depth_sq=True, depth_ref=2.9)


def test_lower_degree_than_stored(isa):
    w = world(bases=16, seed=3)
    out, leaves = w.render("cpu", torch.float32, sh_degree=1)
    gradients = backward(out, leaves)
    assert gradients["sh"][:, :4].norm() > 0 and gradients["sh"][:, 4:].abs().max() == 0
    assert_same_as_reference(w, sh_degree=1)


@pytest.mark.parametrize("features", [1, 4, 7, 16])
@pytest.mark.parametrize("background", ["none", "constant", "image"])
def test_features_and_background(isa, features, background):
    assert_same_as_reference(
        world(features=features, background=background, bases=4, seed=features), depth_sq=features == 4, depth_ref=3.0
    )


def test_absolute_gradient_of_centres(isa):
    assert_same_as_reference(world(seed=5, features=2), absgrad=True, depth_sq=True)


@pytest.mark.parametrize("only", ["colour", "alpha", "depth", "depth_sq"])
def test_one_output_at_a_time(only):
    """Outputs without a gradient are left out of backward."""
    w = world(seed=6, bases=4)
    want, x = w.render("torch_ref", torch.float64, depth_sq=True, depth_ref=2.5)
    got, y = w.render("cpu", torch.float32, depth_sq=True, depth_ref=2.5)
    want, got = backward(want, x, outputs=(only,)), backward(got, y, outputs=(only,))
    for name in want:
        assert relative_error(got[name], want[name]) < 1e-5, name


def test_features_without_gradient():
    """A loss that does not look at the rendered features."""
    w = world(seed=7, features=5)
    want = backward(*w.render("torch_ref", torch.float64), outputs=("colour",))
    got = backward(*w.render("cpu", torch.float32), outputs=("colour",))
    assert got["features"].abs().max() == 0
    assert relative_error(got["means"], want["means"]) < 1e-5


def test_opaque_and_nearly_transparent(isa):
    # pixels finish early; 1 - 0.99 costs float32 two digits of the transmittance
    assert_same_as_reference(
        world(1500, opacity=(0.97, 1.0), scale=(0.03, 0.2), seed=8, background="image"), tolerance=3e-5
    )
    assert_same_as_reference(world(400, opacity=(1 / 255, 0.02), seed=9, background="constant"))


def test_needles_and_specks(isa):
    w = world(400, seed=10)
    w.tensors["scales"][:, 1:] *= 0.02
    w.tensors["scales"][:, 0] *= 4
    # needles are ill conditioned in float32
    want, x = w.render("torch_ref", torch.float64)
    got, y = w.render("cpu", torch.float32)
    assert relative_error(got.colour, want.colour) < 1e-5
    want, got = backward(want, x), backward(got, y)
    for name in want:
        assert relative_error(got[name], want[name]) < 1e-4, name


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("eps2d", [0.1, 0.3, 2.0])
def test_pixels_extent(isa, antialias, eps2d):
    options = {"eps2d": eps2d, "antialias": antialias, "depth_sq": True, "depth_ref": 2.9}
    assert_same_as_reference(world(400, scale=(0.002, 0.03), seed=17, features=2), **options)


def test_at_the_border_and_behind(isa):
    """Most Gaussians are off-screen, behind the camera or at its near plane; the Jacobian's clamp is in use."""
    w = world(1500, spread=2.5, scale=(0.05, 0.4), seed=11, background="constant")
    assert_same_as_reference(w, near=0.3)


def test_median_depth(isa):
    w = world(800, seed=12, scale=(0.05, 0.2))
    want, _ = w.render("torch_ref", torch.float64, grad=False)
    got, _ = w.render("cpu", torch.float32, grad=False)
    assert (want.median_depth > 0).float().mean() > 0.2
    wrong = (want.median_depth - got.median_depth).abs() > 1e-4  # a pixel may sit on the threshold
    assert wrong.float().mean() < 2e-3


def test_radii_and_visibility():
    w = world(800, spread=1.5, seed=13)
    want, got = (w.render(b, d, grad=False)[0].radii for b, d in (("torch_ref", torch.float64), ("cpu", torch.float32)))
    seen = (want > 0) & (got > 0)
    assert seen.sum() > 50 and torch.equal(want[seen], got[seen])
    assert not (
        (want == 0) & (got > 0)
    ).any()  # the native one knows the ellipse, the reference its box: it may cull more


def test_many_tiles(isa):
    """Rows and columns of tiles, a width and a height that no tile divides."""
    assert_same_as_reference(world(600, 131, 97, seed=14, scale=(0.02, 0.3)))


needs_native = pytest.mark.skipif(native is None, reason="p2gs was installed without its native kernels")


@needs_native
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(
    n=st.integers(1, 60),
    width=st.integers(1, 70),
    height=st.integers(1, 70),
    features=st.sampled_from([0, 3]),
    background=st.sampled_from(["none", "constant", "image"]),
    scale=st.floats(0.005, 1.5),
    depth_sq=st.booleans(),
    seed=st.integers(0, 99),
)
def test_any_size(n, width, height, features, background, scale, depth_sq, seed):
    w = world(
        n, width, height, features=features, background=background, bases=4, scale=(0.3 * scale, scale), seed=seed
    )
    want, x = w.render("torch_ref", torch.float64, depth_sq=depth_sq)
    got, y = w.render("cpu", torch.float32, depth_sq=depth_sq)
    assert torch.allclose(got.colour.double(), want.colour, atol=2e-5)
    want, got = backward(want, x), backward(got, y)
    for name in want:
        scale_of = want[name].abs().max().clamp_min(1e-3)
        assert float((got[name] - want[name]).abs().max() / scale_of) < 1e-4, name
