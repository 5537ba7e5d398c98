"""Photometric screw refinement: its tangent gradient, its projections, its result on a scene that is known."""

import pytest
import torch
from tiny import hinge, photographs, slide, textured_panels

from p2gs.data.views import TrainingViews
from p2gs.gaussians.pose import carry, with_static
from p2gs.motion.motion_steps import KINDS, MotionSteps, allowed_step, apply_step
from p2gs.motion.part_pull import tangent_gradient
from p2gs.motion.screw_polish import PolishConfig, Side, polish
from p2gs.ops import se3, so3
from p2gs.ops.ssim import l1_ssim


def test_tangent_gradient_is_the_derivative():
    torch.manual_seed(0)
    means, quats = torch.randn(7, 3).double(), so3.quat_normalize(torch.randn(7, 4).double())
    a, b = torch.randn(7, 3).double(), torch.randn(7, 4).double()
    centre = torch.randn(3).double()

    def loss(step):
        delta = apply_step(torch.eye(4).double(), centre, 1.0, step)
        turned = so3.quat_multiply(so3.matrix_to_quat(delta[:3, :3]).expand(7, 4), quats)
        # matrix_to_quat picks a hemisphere; near the identity it is that of (1, 0, 0, 0)
        return (se3.apply(delta, means) * a).sum() + (turned * b).sum()

    numeric = torch.stack([(loss(e) - loss(-e)) / 2e-6 for e in 1e-6 * torch.eye(6).double()])
    shares = torch.cat(tangent_gradient(means, quats, a, b, centre), 1)
    assert torch.allclose(shares.sum(0), numeric, atol=1e-6)


def allowed(kind, T, centre, radius, step):
    return allowed_step([kind], T[None], centre[None], torch.tensor([radius]), step[None])[0]


def test_revolute_steps_keep_the_pitch_zero_and_prismatic_steps_do_not_turn():
    torch.manual_seed(1)
    T = se3.from_screw(torch.randn(3).double(), torch.randn(3).double(), 0.8)
    centre = torch.randn(3).double()
    for _ in range(20):
        step = allowed("revolute", T, centre, 0.5, 0.02 * torch.randn(6).double())
        T = apply_step(T, centre, 0.5, step)
        assert abs(float(se3.screw_parameters(T).translation)) < 5e-3  # of second order in the step
    for _ in range(2):  # and the next step takes it back
        T = apply_step(T, centre, 0.5, allowed("revolute", T, centre, 0.5, torch.zeros(6).double()))
    assert abs(float(se3.screw_parameters(T).translation)) < 1e-6
    assert allowed("prismatic", T, centre, 0.5, torch.ones(6).double())[:3].abs().sum() == 0
    free = torch.randn(6).double()
    assert torch.equal(allowed("free", T, centre, 0.5, free), free)


def test_the_forbidden_direction_is_the_derivative_of_the_pitch():
    torch.manual_seed(2)
    for _ in range(5):
        T = se3.from_screw(torch.randn(3).double(), torch.randn(3).double(), 0.3 + 2 * float(torch.rand(1)))
        centre, radius = torch.randn(3).double(), 0.4

        def pitch(step, T=T, centre=centre, radius=radius):
            return se3.screw_parameters(apply_step(T, centre, radius, step)).translation

        numeric = torch.stack([(pitch(e) - pitch(-e)) / 2e-6 for e in 1e-6 * torch.eye(6).double()])
        # what a step loses is along the normal
        step = torch.randn(6).double()
        lost = step - allowed("revolute", T, centre, radius, step)
        assert torch.allclose(lost, numeric * (numeric @ step) / (numeric @ numeric), atol=1e-5)


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.7, 3.1, torch.pi])
def test_the_kernel_takes_the_steps_of_the_reference(angle, held):
    torch.manual_seed(3)
    kinds = KINDS * 2
    axes = torch.nn.functional.normalize(torch.randn(len(kinds), 3).double(), dim=1)
    T = torch.stack([se3.from_screw(a, torch.randn(3).double(), angle) for a in axes])
    T[[2, 5], :3, :3] = torch.eye(3).double()
    axes[:2] = torch.nan
    radius, on = torch.rand(len(kinds)) + 0.1, torch.ones(len(kinds)).bool()
    fast, slow = (MotionSteps(kinds, radius, 0.02, axes if held else None) for _ in range(2))
    a = b = T
    for step in range(20):
        gradient, centre = torch.randn(len(kinds), 6).double(), torch.randn(len(kinds), 3).double()
        on[4] = step % 3 > 0
        a = fast.take(a, gradient, centre, step / 20, on)
        b = slow.take_reference(b, gradient, centre, step / 20, on)
        assert torch.allclose(a, b, rtol=0, atol=1e-12)
        a = b  # half a turn's axis has either sign, and steps would go on from one of two motions
    assert torch.equal(fast.taken, slow.taken) and float(fast.taken[4]) == 13
    assert not torch.allclose(a, T, atol=1e-2)


@pytest.mark.parametrize("ways", ["forward", "backward", "both"])
@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_polish_recovers_a_known_motion(kind, ways):
    g, labels = textured_panels()
    if kind == "revolute":
        truth = hinge()
        start = se3.from_screw(torch.tensor([0.05, 0.1, 1]).double(), torch.tensor([0.42, 0.48, 0]).double(), 0.55)
    else:
        truth, start = slide(), slide()
        start[:3, 3] += torch.tensor([-0.03, 0.03, 0.02])
    moved = carry(g, labels, with_static(truth[None]))  # the end state's own Gaussians
    there = Side(g, labels, TrainingViews(photographs(g, labels, truth, 1), [64]))
    back = Side(moved, labels, TrainingViews(photographs(g, labels, torch.eye(4).double(), 0), [64]), back=True)
    sides = {"forward": [there], "backward": [back], "both": [there, back]}[ways]
    config = PolishConfig(steps=120, levels=[64], level_starts=[0.0], rate=1e-2, min_margin=0.0)
    found, losses = polish(sides, start[None], [kind], config, seed=0)
    error = (found[0] @ torch.linalg.inv(truth)).double()
    assert float(so3.rotation_angle(error[:3, :3])) * 57.3 < 0.3
    centre = g.means[labels == 1].double().mean(0)
    at = [(T[:3, :3] @ centre + T[:3, 3]) for T in (found[0], truth)]
    assert float((at[0] - at[1]).norm()) < 0.003
    assert max(losses) < 0.05


def test_a_sides_errors_count_over_their_own_scale(monkeypatch):
    """Photographs of which one side's loss is eight times as large, whatever the reason, give the same motion."""
    g, labels = textured_panels()
    sides = [
        Side(g, labels, TrainingViews(photographs(g, labels, slide(), 1), [64])),
        Side(
            carry(g, labels, with_static(hinge()[None])),
            labels,
            TrainingViews(photographs(g, labels, torch.eye(4).double(), 0), [64]),
            back=True,
        ),
    ]
    config, calls = PolishConfig(steps=12, levels=[64], level_starts=[0.0], rate=1e-2, min_margin=0.0), []

    def ask(factor):
        def loss(*given):
            calls.append(1)
            return l1_ssim(*given) * (factor if len(calls) % 2 else 1)

        calls.clear()
        monkeypatch.setattr("p2gs.motion.screw_polish.l1_ssim", loss)
        return polish(sides, slide()[None], ["prismatic"], config, seed=0)

    (found, losses), (other, more) = ask(1.0), ask(8.0)
    assert torch.allclose(found, other, atol=1e-6) and not torch.allclose(found, slide()[None], atol=1e-3)
    assert more == pytest.approx([8 * losses[0], losses[1]], rel=1e-3)
