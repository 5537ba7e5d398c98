"""Losses on rendered pictures, alpha, opacity and depth."""

import math
from dataclasses import replace

import pytest
import torch
from torch.autograd import gradcheck

from p2gs.losses import LOSSES
from p2gs.losses.base import LossInputs, Target
from p2gs.types import Camera, GaussianTensors, RenderOutput, UserError

F64 = torch.float64


def make_inputs(h=14, w=17, dtype=F64, depth=True):
    g = torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.rand(*shape, generator=g, dtype=F64).to(dtype)  # noqa: E731
    alpha, z = draw(h, w), 1 + draw(h, w)
    render = RenderOutput(draw(h, w, 3), alpha, alpha * z, alpha * draw(h, w) + alpha * (z - 1.5) ** 2, depth_ref=1.5)
    known = draw(h, w) * 2 * (draw(h, w) > 0.3)
    target = Target(
        draw(h, w, 3),
        (draw(h, w) > 0.4).to(dtype),
        torch.ones(3, dtype=dtype),
        known if depth else None,
        key=("view", 1),
    )
    logits = draw(30) * 6 - 3
    gaussians = GaussianTensors(draw(30, 3), draw(30, 4), draw(30, 3), logits, draw(30, 1, 3))
    return LossInputs(0, 100, gaussians, render, target)


def pixels(inputs):
    r, t = inputs.render, inputs.target
    h, w = r.alpha.shape
    return [(y, x, r, t) for y in range(h) for x in range(w)]


def test_render_is_l1_and_structural_similarity():
    from skimage.metrics import structural_similarity

    inputs = make_inputs(40, 37)
    a, b = inputs.render.colour, inputs.target.image
    l1 = sum(abs(x - y) for x, y in zip(a.flatten().tolist(), b.flatten().tolist(), strict=True)) / a.numel()
    assert LOSSES["render"](ssim_lambda=0.0)(inputs).item() == pytest.approx(l1)
    # skimage mirrors at the border where the loss pads with zeros: give it the zeros
    padded = [torch.nn.functional.pad(image, (0, 0, 10, 10, 10, 10)).numpy() for image in (a, b)]
    _, similarity = structural_similarity(
        *padded,
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        full=True,
    )
    whole = LOSSES["render"](ssim_lambda=1.0)(inputs).item()
    assert whole == pytest.approx(1 - similarity[10:-10, 10:-10].mean(), abs=1e-6)
    assert LOSSES["render"]()(inputs).item() == pytest.approx(0.8 * l1 + 0.2 * whole)
    same = replace(inputs, target=replace(inputs.target, image=a))
    assert abs(LOSSES["render"]()(same).item()) < 1e-9


def test_render_with_and_without_a_cache_agree():
    inputs = make_inputs(40, 37, torch.float32)
    loss = LOSSES["render"]()
    bare = LossInputs(0, 100, inputs.gaussians, inputs.render, replace(inputs.target, key=None))
    for _ in range(2):
        torch.testing.assert_close(loss(inputs), loss(bare))
    assert len(inputs.cache) == 1


def test_alpha_is_cross_entropy_and_its_gradient_is_bounded():
    inputs = make_inputs()
    value = 0.0
    for y, x, r, t in pixels(inputs):
        a, b = r.alpha[y, x].item(), t.alpha[y, x].item()
        value -= b * math.log(a) + (1 - b) * math.log(1 - a)
    assert LOSSES["alpha"](weight=1.0)(inputs).item() == pytest.approx(value / inputs.render.alpha.numel(), rel=1e-3)
    alpha = torch.tensor([[0.0, 1.0, 0.0, 1.0]], requires_grad=True)
    hard = replace(
        inputs,
        render=replace(inputs.render, alpha=alpha),
        target=replace(inputs.target, alpha=torch.tensor([[0.0, 1.0, 1.0, 0.0]])),
    )
    LOSSES["alpha"]()(hard).backward()
    assert torch.isfinite(alpha.grad).all()
    assert alpha.grad.abs().max() < 1e4


def test_opacity_pushes_away_from_one_half():
    inputs = make_inputs()
    value = sum(math.log(1 + math.exp(-abs(x))) for x in inputs.gaussians.opacity_logits.tolist()) / 30
    assert LOSSES["opacity"](weight=1.0)(inputs).item() == pytest.approx(value)
    logits = torch.tensor([-1.0, 1.0], requires_grad=True)
    LOSSES["opacity"]()(replace(inputs, gaussians=replace(inputs.gaussians, opacity_logits=logits))).backward()
    assert logits.grad[0] > 0 > logits.grad[1]
    order = torch.randperm(30)
    torch.testing.assert_close(
        LOSSES["opacity"]()(replace(inputs, gaussians=inputs.gaussians[order])), LOSSES["opacity"]()(inputs)
    )


def test_flat_shrinks_the_shortest_axis_alone():
    scales = torch.tensor([[0.3, 0.1, 0.2], [0.4, 0.5, 0.05]], dtype=F64)
    logs = scales.log().requires_grad_()
    value = LOSSES["flat"]()(LossInputs(0, 100, replace(make_inputs().gaussians[torch.arange(2)], log_scales=logs)))
    assert value.item() == pytest.approx((0.1 + 0.05) / 2)
    value.backward()
    torch.testing.assert_close(logs.grad, torch.tensor([[0, 0.05, 0], [0, 0, 0.025]], dtype=F64))


def test_depth_is_logarithmic_over_what_is_known():
    inputs = make_inputs()
    terms = []
    for y, x, r, t in pixels(inputs):
        if t.depth[y, x] > 0 and r.alpha[y, x] > 0.1:
            terms.append(math.log(1 + abs((r.depth[y, x] / r.alpha[y, x] - t.depth[y, x]).item())))
    assert 0 < len(terms) < inputs.render.alpha.numel()
    assert LOSSES["depth"](weight=1.0)(inputs).item() == pytest.approx(sum(terms) / len(terms))
    nothing = replace(inputs, target=replace(inputs.target, depth=torch.zeros_like(inputs.target.depth)))
    assert LOSSES["depth"]()(nothing).item() == 0


def test_depth_leaves_out_what_lies_next_to_a_jump():
    inputs = make_inputs()
    r = inputs.render
    terms = [
        math.log(1 + abs((r.depth[y, x] / r.alpha[y, x] - inputs.target.depth[y, x]).item()))
        for y, x in away_from_jumps(inputs, 1.2)
    ]
    assert 0 < len(terms) < 60
    assert LOSSES["depth"](weight=1.0, edge=1.2)(inputs).item() == pytest.approx(sum(terms) / len(terms))


def away_from_jumps(inputs, edge):
    """(row, column) of pixels of known depth that are covered, about which known depth differs by ``edge`` at most."""
    known, out = inputs.target.depth, []
    for y in range(known.shape[0]):
        for x in range(known.shape[1]):
            around = known[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
            around = around[around > 0]  # what is not known is no jump
            if known[y, x] > 0 and inputs.render.alpha[y, x] > 0.1 and around.max() - around.min() <= edge:
                out.append((y, x))
    return out


def test_surface_depth_is_where_rays_meet_planes():
    inputs = make_inputs()
    h, w = inputs.target.depth.shape
    K = torch.tensor([[20.0, 0, 8], [0, 21, 7], [0, 0, 1]])
    facing = torch.tensor([0.4, -0.3, 1.0], dtype=F64)
    planes = (
        torch.cat([facing.expand(h, w, 3), 1 + torch.rand(h, w, 1, dtype=F64)], -1) * inputs.render.alpha[..., None]
    )
    inputs = replace(inputs, render=replace(inputs.render, features=planes), camera=Camera(torch.eye(4), K, w, h))
    terms = []
    for y, x in away_from_jumps(inputs, 1.2):
        ray = torch.tensor([(x + 0.5 - 8) / 20, (y + 0.5 - 7) / 21, 1], dtype=F64)
        met = planes[y, x, 3] / (planes[y, x, :3] @ ray)
        terms.append(math.log(1 + abs((met - inputs.target.depth[y, x]).item())))
    loss = LOSSES["surface_depth"](weight=1.0, edge=1.2)
    assert loss(inputs).item() == pytest.approx(sum(terms) / len(terms))
    assert loss(replace(inputs, render=replace(inputs.render, features=None))) is None
    assert loss(replace(inputs, target=replace(inputs.target, depth=None))) is None


def test_depth_variance_is_twice_its_mean_over_the_foreground():
    inputs = make_inputs()
    terms = []
    for y, x, r, t in pixels(inputs):
        if t.alpha[y, x] > 0.5:
            A, first, second = r.alpha[y, x], r.depth[y, x] - 1.5 * r.alpha[y, x], r.depth_sq[y, x]
            terms.append((A * second - first * first).item())
    assert LOSSES["depth_variance"](weight=1.0, end_weight=None)(inputs).item() == pytest.approx(
        2 * sum(terms) / len(terms)
    )
    bent = [v / (1 + v / 0.25) for v in terms]  # v is up to three times knee^2
    assert LOSSES["depth_variance"](weight=1.0, end_weight=None, knee=0.5)(inputs).item() == pytest.approx(
        2 * sum(bent) / len(bent)
    )
    default = LOSSES["depth_variance"]()
    assert default.weight_at(0, 100) == 30
    assert default.weight_at(50, 100) == pytest.approx(math.sqrt(300))
    assert default.weight_at(100, 100) == pytest.approx(10)
    # all of the ray at one depth: none
    r = inputs.render
    first = r.depth - 1.5 * r.alpha
    flat = replace(inputs, render=replace(r, depth_sq=first * first / r.alpha))
    assert default(flat).abs().item() < 1e-9


def test_depth_variance_pulls_two_surfaces_less_than_fog():
    """A ray that meets half of its light at either of two depths: the pull on the nearer one's opacity."""

    def pull(apart: float, knee: float | None) -> float:
        nearer = torch.tensor(0.4, dtype=F64, requires_grad=True)
        share = torch.stack([nearer, 1 - nearer])
        z = torch.tensor([-apart / 2, apart / 2], dtype=F64)
        first, second = (share * z).sum(), (share * z * z).sum()
        render = replace(
            make_inputs().render,
            alpha=torch.ones(1, 1, dtype=F64),
            depth=first.reshape(1, 1),
            depth_sq=second.reshape(1, 1),
            depth_ref=0.0,
        )
        target = replace(make_inputs().target, alpha=torch.ones(1, 1, dtype=F64))
        loss = LOSSES["depth_variance"](weight=1.0, end_weight=None, knee=knee)
        return torch.autograd.grad(loss(replace(make_inputs(), render=render, target=target)), nearer)[0].item()

    assert pull(0.02, 0.1) == pytest.approx(pull(0.02, None), rel=0.03)
    assert 0 < pull(0.6, 0.1) < 0.05 * pull(0.6, None)
    with pytest.raises(UserError, match="knee: expected a length above 0 or null, got 0"):
        LOSSES["depth_variance"](knee=0.0)


@pytest.mark.parametrize("name", ["render", "alpha", "depth", "depth_variance"])
def test_gradients_against_finite_differences(name):
    inputs, loss = make_inputs(5, 4), LOSSES[name]()
    r = inputs.render
    fields = ("colour", "alpha", "depth", "depth_sq")

    def value(*tensors):
        return loss(replace(inputs, render=replace(r, **dict(zip(fields, tensors, strict=True)))))

    assert gradcheck(value, [getattr(r, f).clone().requires_grad_() for f in fields], eps=1e-7, atol=1e-4)


def wall(depth, image=None):
    """A view [H, W] of what lies at ``depth``, photographed as ``image`` (default: one colour), seen everywhere."""
    h, w = depth.shape
    ones = torch.ones(h, w, dtype=F64)
    image = torch.full((h, w, 3), 0.5, dtype=F64) if image is None else image
    render = RenderOutput(image, ones, depth.clone(), None, depth_ref=0.0)
    return LossInputs(0, 100, None, render, Target(image, ones, torch.ones(3, dtype=F64)))


def tilted(h=30, w=40):
    """Depth of a tilted plane under a pinhole: its inverse is linear in the pixel."""
    y, x = torch.meshgrid(torch.arange(h, dtype=F64), torch.arange(w, dtype=F64), indexing="ij")
    return 1 / (0.4 + 0.002 * x - 0.003 * y)


def test_planar_is_nothing_on_a_plane_and_something_on_a_dent():
    loss, plane = LOSSES["planar"](weight=1.0), tilted()
    assert loss(wall(plane)).item() < 1e-12
    y, x = torch.meshgrid(torch.arange(30), torch.arange(40), indexing="ij")
    dent = 0.05 * torch.exp(-((x - 20) ** 2 + (y - 15) ** 2) / 50.0)
    shallow, deep = (loss(wall(plane + k * dent)).item() for k in (1.0, 2.0))
    assert 1.8 < deep / shallow < 2.2 and shallow > 1e-4
    # where the photograph shows something, it decides
    pattern = torch.rand(30, 40, 3, generator=torch.Generator().manual_seed(0), dtype=F64)
    assert loss(wall(plane + dent, pattern)).item() < 0.02 * shallow


def test_planar_stops_at_edges_of_the_photograph_and_at_the_outline():
    loss, near = LOSSES["planar"](weight=1.0, strides=(3,)), torch.full((24, 24), 2.0, dtype=F64)
    step = near.clone()
    step[:, 12:] = 3.0
    image = torch.full((24, 24, 3), 0.2, dtype=F64)
    image[:, 12:] = 0.9  # the edge of a body is an edge of the picture
    assert loss(wall(step)).item() > 0.05 > 20 * loss(wall(step, image)).item()
    inputs = wall(step)
    outline = inputs.target.alpha.clone()
    outline[:, 12] = 0.0
    assert loss(replace(inputs, target=replace(inputs.target, alpha=outline))).item() < 1e-9


def test_planar_against_its_slow_twin():
    inputs = make_inputs(20, 23)
    inputs = replace(inputs, render=replace(inputs.render, alpha=0.6 + 0.4 * inputs.render.alpha))
    r, t, loss = inputs.render, inputs.target, LOSSES["planar"](weight=1.0, strides=(2, 4), contrast=2.0)
    inside = (t.alpha > 0.9) & (r.alpha > 0.5)
    depth, terms = r.depth / r.alpha, []
    for dy, dx in ((1, 0), (0, 1)):
        for s in loss.strides:
            total = weights = 0.0
            for y in range(20 - 2 * s * dy):
                for x in range(23 - 2 * s * dx):
                    line = [(y + i * dy, x + i * dx) for i in range(2 * s + 1)]
                    if not all(inside[p] for p in line):
                        continue
                    steps = [
                        (t.image[a] - t.image[b]).abs().mean().item() for a, b in zip(line, line[1:], strict=False)
                    ]
                    tv = sum(max(step - loss.noise, 0) for step in steps)
                    z = [depth[line[i]].item() for i in (0, s, 2 * s)]
                    w = math.exp(-tv / loss.contrast)
                    total += w * abs(1 / z[0] - 2 / z[1] + 1 / z[2]) * z[1] ** 2
                    weights += w
            terms.append(total / max(weights, 1))
    assert loss(inputs).item() == pytest.approx(sum(terms) / len(terms), rel=1e-6)


def test_missing_inputs_give_none():
    inputs = make_inputs(depth=False)
    for name in ("render", "alpha", "depth", "depth_variance", "planar"):
        assert LOSSES[name]()(LossInputs(0, 100, inputs.gaussians)) is None
    assert LOSSES["depth"]()(inputs) is None
    assert LOSSES["depth_variance"]()(replace(inputs, render=replace(inputs.render, depth_sq=None))) is None
