"""Every part loss against the paper's formula written as loops, and its invariances, gradients and switches."""

import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch.autograd import gradcheck

sys.path.insert(0, str(Path(__file__).parent))
from scene_of_parts import F64, doubled, make_inputs, permuted, turned, with_parts  # noqa: E402

from p2gs.losses import LOSSES  # noqa: E402
from p2gs.losses.base import LossInputs  # noqa: E402
from p2gs.ops import se3, so3  # noqa: E402

NAMES = [
    ("part", {}),
    ("part", {"variant": "pairwise"}),
    ("entropy", {}),
    ("vector", {}),
    ("vector", {"robust": 0.1}),
    ("velocity", {}),
    ("velocity", {"variant": "paper"}),
    ("art", {}),
    ("art", {"variant": "paper"}),
    ("art", {"source": "canonical", "sign": "away", "reduce": "sum"}),
    ("contact", {"margin": 4.0}),
    ("contact", {"variant": "paper"}),
]
IDS = ["-".join([n, *map(str, o.values())]) for n, o in NAMES]
each_loss = pytest.mark.parametrize(("name", "options"), NAMES, ids=IDS)


def build(name, **options):
    """The loss at weight 1 over all Gaussians."""
    cls = LOSSES[name]
    if "sample" in cls.__dataclass_fields__:
        options = {"sample": 0, **options}
    return cls(**{"weight": 1.0, **options})


# -- the formulas as loops --------------------------------------------------------------------------------------------
def kl(p, q):
    return sum(a * math.log(a / b) for a, b in zip(p, q, strict=True))


def norm(v):
    return math.sqrt(sum(x * x for x in v))


def move(T, x):
    return [sum(T[r][c] * x[c] for c in range(3)) + T[r][3] for r in range(3)]


def minus(a, b):
    return [x - y for x, y in zip(a, b, strict=True)]


def part_naive(p, variant):
    total = 0.0
    for own, neighbours in zip(p.probs.tolist(), p.knn.tolist(), strict=True):
        others = [p.probs[j].tolist() for j in neighbours]
        if variant == "pairwise":
            total += sum(kl(own, o) for o in others) / len(others)
        else:
            total += kl(own, [sum(column) / len(others) for column in zip(*others, strict=True)])
    return total / len(p.probs)


def vector_naive(p, robust=None):
    total = 0.0
    for i, m0, m1 in zip(p.pairs.tolist(), p.mu0.tolist(), p.mu1.tolist(), strict=True):
        for k, T in enumerate(p.transforms.tolist()):
            sq = norm(minus(move(T, m0), m1)) ** 2
            s = None if robust is None else (robust * p.extent) ** 2
            total += p.probs[i, k].item() * (sq if s is None else s * sq / (s + sq))
    return total / len(p.pairs)


def velocity_naive(p, variant):
    total = 0.0
    for k, T in enumerate(p.transforms.tolist()):
        weights = [p.probs[i, k].item() for i in p.pairs.tolist()]
        moves = [
            minus(m1, m0) if variant == "paper" else minus(move(T, m0), m1)
            for m0, m1 in zip(p.mu0.tolist(), p.mu1.tolist(), strict=True)
        ]
        mass = sum(weights)
        mean = [sum(w * m[c] for w, m in zip(weights, moves, strict=True)) / mass for c in range(3)]
        total += sum(w * norm(minus(m, mean)) ** 2 for w, m in zip(weights, moves, strict=True)) / mass
    return total / len(p.transforms)


def force_naive(x, p, tau, radius=None, k_r=5e-4, eps=1e-5, strength=0.005):
    """With a radius every point within it exerts ``strength`` tau_max (radius / d)^2, tau_max 0.01 of the extent; else
    the paper's sum."""
    total = [0.0] * 3
    for r in p.repel_points.tolist():
        offset = minus(r, x)
        if radius is None or norm(offset) < radius:
            unit = k_r if radius is None else strength * 0.01 * p.extent * radius**2
            total = [t + unit * o / max(norm(offset), eps) ** 3 for t, o in zip(total, offset, strict=True)]
    return [t * min(1.0, tau / norm(total)) for t in total] if norm(total) else total


def angle_naive(A, B):
    return math.acos(max(-1.0, min(1.0, ((A.T @ B).trace().item() - 1) / 2)))


def art_naive(p, tau, radius, lambda_rot=0.1):
    total = 0.0
    for i, m0, m1 in zip(p.pairs.tolist(), p.mu0.tolist(), p.mu1.tolist(), strict=True):
        for k, T in enumerate(p.transforms.tolist()):
            x = move(T, m0)
            if k > 0 and p.probs[i, k] > 0.01:
                x = [a + b for a, b in zip(x, force_naive(x, p, tau, radius), strict=True)]
            total += p.probs[i, k].item() * norm(minus(x, m1)) ** 2
    angles = [angle_naive(T[:3, :3], R) for T, R in zip(p.transforms[1:], p.target_rotation[1:], strict=True)]
    return total / len(p.pairs) + lambda_rot * sum(angles) / len(angles)


def art_paper_naive(p, tau, lambda_rot=0.1):
    total = 0.0
    for i, m0, m1 in zip(p.pairs.tolist(), p.mu0.tolist(), p.mu1.tolist(), strict=True):
        q = p.probs[i].tolist()
        xs = [move(T, m0) for T in p.transforms.tolist()]
        x = [sum(w * c[d] for w, c in zip(q, xs, strict=True)) for d in range(3)]
        F = force_naive(x, p, tau)
        total += norm([a + (1 - q[0]) * f - b for a, f, b in zip(x, F, m1, strict=True)]) ** 2
    return total + lambda_rot * sum(
        angle_naive(T[:3, :3], R) for T, R in zip(p.transforms[1:], p.target_rotation[1:], strict=True)
    )


def contact_naive(p, time, margin):
    labels = p.probs.argmax(1).tolist()
    static = [m for m, k in zip(p.means_canonical.tolist(), labels, strict=True) if k == 0]
    centre = [sum(c) / len(static) for c in zip(*static, strict=True)]
    poses = se3.screw_at(p.transforms, time - p.canonical_time).tolist()
    terms = {}
    for m, k in zip(p.means_canonical.tolist(), labels, strict=True):
        if k == 0:
            continue
        x = move(poses[k], m)
        d_i = min((minus(x, s) for s in static), key=norm)
        d_k = minus(x, centre)
        cosine = sum(a * b for a, b in zip(d_i, d_k, strict=True)) / norm(d_i) / norm(d_k)
        weight = 1.0 if margin is None else max(0.0, 1 - norm(d_i) / (margin * p.spacing))
        terms.setdefault(k, []).append(weight * max(0.0, -cosine))
    return sum(sum(t) / len(t) for t in terms.values()) / len(terms)


@pytest.mark.parametrize("seed", [0, 1])
def test_losses_are_their_formulas(seed):
    inputs = make_inputs(seed=seed, step=30)
    p = inputs.parts
    tau = 0.01 * p.extent
    annealed = tau * (1 - 0.3 / 0.75)
    expected = [
        (build("part"), part_naive(p, "mean_neighbour")),
        (build("part", variant="pairwise", reduce="sum"), part_naive(p, "pairwise") * len(p.probs)),
        (build("entropy"), -sum(a * math.log(a) for row in p.probs.tolist() for a in row) / len(p.probs)),
        (build("vector"), vector_naive(p)),
        (build("vector", reduce="sum", robust=0.05), vector_naive(p, 0.05) * len(p.pairs)),
        (build("velocity"), velocity_naive(p, "rigid")),
        (build("velocity", variant="paper", reduce="sum"), 3 * velocity_naive(p, "paper")),
        (build("art"), art_naive(p, annealed, 0.05 * p.extent)),
        (build("art", radius=0.3, anneal=0.0), art_naive(p, tau, 0.3 * p.extent)),
        (build("art", variant="paper", reduce="sum"), art_paper_naive(p, tau)),
        (build("contact", times=(0.8,), margin=3.0), contact_naive(p, 0.8, 3.0)),
        (build("contact", times=(0.0,), variant="paper"), contact_naive(p, 0.0, None)),
    ]
    for loss, value in expected:
        assert value > 0, loss
        assert loss(inputs).item() == pytest.approx(value, rel=1e-9), loss


# -- invariances ------------------------------------------------------------------------------------------------------
@each_loss
def test_the_world_frame_does_not_matter(name, options):
    inputs, loss = make_inputs(seed=2), build(name, **options)
    R, t = so3.rotvec_to_matrix(torch.tensor([0.5, -2.0, 1.0], dtype=F64)), torch.tensor([2.0, -1.0, 0.5], dtype=F64)
    torch.testing.assert_close(loss(turned(inputs, R, t)), loss(inputs), rtol=1e-6, atol=1e-9)


@each_loss
def test_the_order_of_gaussians_does_not_matter(name, options):
    inputs, loss = make_inputs(seed=3), build(name, **options)
    order = torch.randperm(len(inputs.parts.probs), generator=torch.Generator().manual_seed(9))
    torch.testing.assert_close(loss(permuted(inputs, order)), loss(inputs))


@each_loss
def test_doubling_every_gaussian_changes_no_mean(name, options):
    inputs, loss = make_inputs(seed=4), build(name, **{**options, "reduce": "mean"} if "reduce" in options else options)
    torch.testing.assert_close(loss(doubled(inputs)), loss(inputs))


@pytest.mark.parametrize("name", ["part", "vector", "art"])
def test_the_sum_grows_with_the_number(name):
    inputs, loss = make_inputs(seed=4), build(name, reduce="sum", **({"lambda_rot": 0.0} if name == "art" else {}))
    torch.testing.assert_close(loss(doubled(inputs)), 2 * loss(inputs))


# -- gradients --------------------------------------------------------------------------------------------------------
@each_loss
def test_gradients_against_finite_differences(name, options):
    inputs = make_inputs(n=14, seed=5)
    loss = build(name, **options)
    logits = inputs.parts.probs.log()
    xi = se3.log(inputs.parts.transforms[1:])

    def value(logits, xi, means):
        T = torch.cat([torch.eye(4, dtype=F64)[None], se3.exp(xi)])
        return loss(with_parts(inputs, probs=logits.softmax(-1), transforms=T, means_canonical=means))

    arguments = [a.detach().clone().requires_grad_() for a in (logits, xi, inputs.parts.means_canonical)]
    assert gradcheck(value, arguments, eps=1e-7, atol=1e-5)


def gradients(loss, inputs):
    p = inputs.parts
    leaves = {n: getattr(p, n).detach().clone().requires_grad_() for n in ("probs", "transforms", "means_canonical")}
    value = loss(with_parts(inputs, **leaves))
    found = torch.autograd.grad(value, list(leaves.values()), allow_unused=True)
    return {n for n, g in zip(leaves, found, strict=True) if g is not None and g.abs().max() > 0}


def test_who_learns_from_what():
    inputs = make_inputs(seed=6)
    assert gradients(build("part"), inputs) == {"probs"}
    assert gradients(build("vector"), inputs) == {"probs", "transforms"}
    assert gradients(build("velocity"), inputs) == {"probs", "transforms"}
    assert gradients(build("velocity", variant="paper"), inputs) == {"probs"}
    assert gradients(build("art"), inputs) == {"probs", "transforms"}
    assert gradients(build("art", source="canonical"), inputs) == {"probs", "transforms", "means_canonical"}
    assert gradients(build("contact", variant="paper"), inputs) == {"transforms", "means_canonical"}


@each_loss
def test_gradients_stay_finite_when_everything_is_certain_and_coincides(name, options):
    inputs = make_inputs(seed=7, sharp=True, noise=0.0)
    p = inputs.parts
    means = p.means_canonical.clone()
    means[p.probs.argmax(1) > 0] = means[p.probs.argmax(1) == 0][0]
    inputs = with_parts(inputs, means_canonical=means, target_rotation=p.transforms[:, :3, :3], repel_points=p.mu1[:5])
    leaves = [x.detach().clone().requires_grad_() for x in (p.probs, p.transforms, means)]
    inputs = with_parts(inputs, probs=leaves[0], transforms=leaves[1], means_canonical=leaves[2])
    value = build(name, **{**options, **({"times": (0.3,)} if name == "contact" else {})})(inputs)
    assert torch.isfinite(value)
    for g in torch.autograd.grad(value, leaves, allow_unused=True):
        assert g is None or torch.isfinite(g).all()


# -- what the terms are for -------------------------------------------------------------------------------------------
def test_a_true_rigid_motion_costs_nothing_but_the_paper_velocity_charges_for_turning():
    inputs = make_inputs(seed=8, sharp=True, noise=0.0)
    for name in ("vector", "velocity"):
        assert build(name)(inputs).item() < 1e-12
    assert build("art", k_r=0.0, lambda_rot=0.0)(inputs).item() < 1e-12
    assert build("velocity", variant="paper")(inputs).item() > 0.01


def test_agreement_with_neighbours_costs_nothing():
    inputs = make_inputs(seed=9)
    same = with_parts(inputs, probs=torch.tensor([[0.2, 0.5, 0.3]], dtype=F64).expand(40, 3))
    for variant in ("mean_neighbour", "pairwise"):
        assert build("part", variant=variant)(same).abs().item() < 1e-12
    assert build("entropy")(with_parts(inputs, probs=torch.eye(3, dtype=F64)[[0] * 40])).abs().item() < 1e-9


def test_the_optimum_of_the_articulation_loss_lies_away_from_repel_points():
    """A plate whose target is 0.02 from a wall: with the paper's sign it settles further away, by tau_max; reversed,
    nearer."""
    y, z = torch.meshgrid(
        torch.linspace(-0.5, 0.5, 9, dtype=F64), torch.linspace(-0.5, 0.5, 9, dtype=F64), indexing="ij"
    )
    plate = torch.stack([torch.zeros_like(y), y, z], -1).reshape(-1, 3)
    wall = plate - torch.tensor([0.02, 0.0, 0.0], dtype=F64)
    inputs = make_inputs(n=81, total=10**6)
    inputs = with_parts(
        inputs,
        pairs=torch.arange(81),
        mu0=plate,
        mu1=plate,
        repel_points=wall,
        extent=1.0,
        probs=torch.tensor([[0.0, 1.0]], dtype=F64).expand(81, 2),
        target_rotation=None,
    )
    settled = {}
    for sign in ("paper", "away"):
        loss = build("art", sign=sign, radius=0.1, strength=0.1)  # at its clip there
        x = torch.zeros((), dtype=F64, requires_grad=True)
        optimizer = torch.optim.Adam([x], lr=1e-3)
        for _ in range(150):
            T = torch.eye(4, dtype=F64).repeat(2, 1, 1)
            shift = torch.zeros(2, 4, 4, dtype=F64)
            shift[1, 0, 3] = 1
            optimizer.zero_grad()
            loss(with_parts(inputs, transforms=T + x * shift)).backward()
            optimizer.step()
        settled[sign] = x.item()
    assert settled["paper"] == pytest.approx(0.01, abs=2e-3)
    assert settled["away"] < -0.003


@pytest.mark.parametrize("exponent", [2.0, 3.0, 4.0])
def test_exponent_and_count_of_repel_points_act_below_the_clip(exponent):
    """A part 0.05 from a wall with 20 points in reach: half to twice as many points are half to twice the force; p
    changes it, too."""
    inputs = make_inputs(n=40)
    wall = 0.04 * torch.randn(40, 3, generator=torch.Generator().manual_seed(1), dtype=F64) + torch.tensor(
        [0.05, 0.0, 0.0], dtype=F64
    )
    x = torch.zeros(1, 3, dtype=F64)
    extent = inputs.parts.extent
    loss = build("art", exponent=exponent, radius=0.1 / extent)
    tau = loss.tau(extent, 0, 100)
    forces = [loss.force(x, torch.cat([wall] * n), extent, tau).norm().item() for n in (1, 2)]
    assert 0 < forces[0] < forces[1] < tau and forces[1] == pytest.approx(2 * forces[0])
    other = build("art", exponent=exponent + 1, radius=0.1 / extent).force(x, wall, extent, tau).norm().item()
    assert other > 1.1 * forces[0]


def test_the_force_is_annealed_away():
    loss = build("art", lambda_rot=0.0, strength=0.2)
    inputs = make_inputs(seed=10, sharp=True, noise=0.0)
    inputs = with_parts(inputs, repel_points=inputs.parts.mu1 + 0.03)
    early, late = loss(inputs).item(), loss(replace(inputs, step=75)).item()
    assert early > 1e-5
    assert late < 1e-12
    assert build("art", variant="paper", lambda_rot=0.0)(replace(inputs, step=75)).item() > 1e-5


def drawer_in_a_cabinet(inside: float):
    """Contact inputs: a drawer box in a snug open cabinet, pushed ``inside`` of a wall."""
    g = torch.Generator().manual_seed(0)
    face = lambda n: torch.rand(n, 2, generator=g, dtype=F64) * 2 - 1  # noqa: E731

    def box(half, n, faces):
        out = []
        for axis, sign in faces:
            uv = face(n) * torch.tensor(half, dtype=F64)[[a for a in range(3) if a != axis]]
            out.append(torch.cat([uv[:, :axis], torch.full((n, 1), sign * half[axis], dtype=F64), uv[:, axis:]], 1))
        return torch.cat(out)

    walls = [(0, -1), (1, -1), (1, 1), (2, -1), (2, 1)]
    base, drawer = box((0.5, 0.5, 0.5), 2000, walls), box((0.4, 0.4, 0.4), 500, walls)
    drawer = drawer + torch.tensor([0.0, 0.1 + inside, 0.0], dtype=F64) * (inside != 0)
    means = torch.cat([base, drawer])
    probs = torch.zeros(len(means), 2, dtype=F64)
    probs[: len(base), 0] = 1
    probs[len(base) :, 1] = 1
    inputs = make_inputs()
    return with_parts(
        inputs,
        probs=probs,
        means_canonical=means,
        transforms=torch.eye(4, dtype=F64).repeat(2, 1, 1),
        spacing=0.02,
        pairs=None,
        mu0=None,
        mu1=None,
    )


def test_contact_by_the_letter_punishes_containment_and_the_margin_does_not():
    contained, touching = drawer_in_a_cabinet(0.0), drawer_in_a_cabinet(-0.01)
    assert build("contact", variant="paper")(contained).item() > 0.5
    assert build("contact")(contained).item() < 1e-6
    assert build("contact")(touching).item() > 1e-3


# -- switches ---------------------------------------------------------------------------------------------------------
@each_loss
def test_missing_inputs_give_none(name, options):
    inputs, loss = make_inputs(), build(name, **options)
    assert loss(LossInputs(0, 100, inputs.gaussians)) is None
    if name in ("vector", "velocity", "art"):
        assert loss(with_parts(inputs, pairs=None)) is None
        assert loss(with_parts(inputs, pairs=torch.zeros(0, dtype=torch.int64))) is None
    if name == "part":
        assert loss(with_parts(inputs, knn=None)) is None
    if name == "contact":
        everything_static = torch.tensor([[1.0, 0.0, 0.0]], dtype=F64).expand(40, 3)
        assert loss(with_parts(inputs, probs=everything_static)) is None


def test_art_without_repel_points_or_target_rotation():
    inputs = make_inputs(seed=11)
    bare = with_parts(inputs, repel_points=None, target_rotation=None)
    torch.testing.assert_close(build("art")(bare), build("vector")(bare))


def test_span_and_weights():
    inputs = make_inputs(step=50)
    value = build("vector")(inputs)
    torch.testing.assert_close(LOSSES["vector"](weight=4.0, end_weight=1.0, sample=0)(inputs), value * 2)
    assert LOSSES["vector"](start=0.6)(inputs) is None
    assert LOSSES["vector"](end=0.5)(inputs) is None
    assert LOSSES["vector"](weight=0.0)(inputs) is None


@pytest.mark.parametrize("name", ["part", "vector", "velocity", "art", "contact"])
def test_sampling_depends_on_the_step_alone(name):
    inputs = make_inputs(n=400, seed=12)
    loss = LOSSES[name](sample=60, **({"variant": "paper"} if name == "contact" else {}))
    first, again, other = loss(inputs), loss(inputs), loss(replace(inputs, step=2))
    assert first == again
    assert first != other
    values = torch.stack([loss(replace(inputs, step=s)) for s in range(0, 80, 2)])
    if name in ("part", "vector"):
        full = LOSSES[name](sample=0)(inputs)
        torch.testing.assert_close(values.mean(), full, rtol=0.1, atol=0)


def test_per_part_canonical_times_are_taken():
    inputs = make_inputs(seed=13)
    times = torch.full((3,), 0.3, dtype=F64)
    for name, options in (("contact", {"variant": "paper"}), ("art", {"source": "canonical"})):
        loss = build(name, **options)
        torch.testing.assert_close(loss(with_parts(inputs, canonical_time=times)), loss(inputs))
