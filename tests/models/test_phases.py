"""Phases train, resume bit for bit, and hand over; every loss can be switched off."""

import pytest
import torch
from lightning.pytorch import Trainer
from tiny import TinyData, hinge, textured_panels, tiny_scene, visit

import p2gs.losses  # noqa: F401  (registers the built-in losses)
from p2gs.callbacks.checkpoint import Checkpoint
from p2gs.callbacks.densify import Densify
from p2gs.data.views import TrainingViews
from p2gs.gaussians import handover
from p2gs.gaussians.draw import render_gaussians
from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.losses.base import LOSSES
from p2gs.models.articulation import ArticulationPhase
from p2gs.models.articulation_options import ArticulationConfig
from p2gs.models.canonical_fusion import CanonicalFusionConfig, CanonicalFusionPhase
from p2gs.models.sharpen import SharpenConfig, SharpenPhase
from p2gs.models.single_state import SingleStateConfig, SingleStatePhase, SplatRates
from p2gs.motion.screw_polish import MovedGaussians
from p2gs.ops import se3, so3
from p2gs.types import GaussianTensors, UserError

ARTICULATION_LOSSES = ("render", "part", "art", "contact", "velocity", "vector")


def losses(*names):
    return {n: LOSSES[n]() for n in names}


@pytest.fixture(scope="module")
def scene():
    return tiny_scene(hinge())


@pytest.fixture(scope="module")
def views(scene):
    return {s: TrainingViews(scene.select(state=s), [24, 48]) for s in (0, 1)}


def states_and_motions():
    g, labels = textured_panels()
    body = MovedGaussians(g, labels)
    means, quats, sh = body.moved(hinge()[None])
    g1 = GaussianTensors(means, quats, g.log_scales, g.opacity_logits, sh)
    motions = PartMotions(["revolute"], hinge()[None], torch.ones(1), [labels, labels], [torch.ones(len(labels))] * 2)
    return [StateGaussians(0, g), StateGaussians(1, g1)], motions


def build(name, scene, views, chosen=None, **options):
    common = {"seed": 3, "rasterizer": "auto"}
    if name == "single_state":
        config = SingleStateConfig(steps=24, initial_gaussians=200, levels=[24, 48], level_starts=[0.0, 0.5], **options)
        return SingleStatePhase(
            config, losses(*(chosen or ("render", "alpha", "depth_variance"))), scene, 0, views[0], **common
        )
    states, motions = states_and_motions()
    if name == "sharpen":
        config = SharpenConfig(steps=24, levels=[48], **options)
        chosen = chosen or ("render", "depth_variance", "flat")
        return SharpenPhase(config, losses(*chosen), states[1], views[1], seed=3, rasterizer=config.backend("auto"))
    if name == "canonical_fusion":
        config = CanonicalFusionConfig(steps=24, levels=[24, 48], level_starts=[0.0, 0.5], **options)
        return CanonicalFusionPhase(config, losses(*(chosen or ("render",))), states, motions, views, **common)
    config = ArticulationConfig(steps=24, levels=[48], refresh=4, **options)
    fused = CanonicalFusionPhase(CanonicalFusionConfig(), {}, states, motions, views, **common).hand_over()
    return ArticulationPhase(
        config, losses(*(chosen or ARTICULATION_LOSSES)), fused, states, motions, 2, 2.0, views, **common
    )


def fit(phase, folder, until=None, resume=None, densify=True):
    callbacks = [Checkpoint(every=12)]
    if densify:
        callbacks.insert(0, Densify(budget=260, every=6, start=0.0, stop=0.9))
    steps = phase.total_steps if until is None else until
    trainer = Trainer(
        max_steps=steps,
        max_epochs=-1,
        accelerator="cpu",
        logger=False,
        callbacks=callbacks,
        default_root_dir=folder,
        enable_progress_bar=False,
        enable_model_summary=False,
        enable_checkpointing=False,
    )
    trainer.fit(phase, datamodule=TinyData(), ckpt_path=resume, weights_only=True)
    return phase


def test_only_what_losses_ask_for_is_made(scene, views):
    def made(*chosen):
        phase = build("articulation", scene, views, chosen)
        return phase.inputs(visit(phase))

    plain = made("render", "flat")
    assert plain.parts is None and plain.render.depth_sq is None
    some = made("render", "part", "depth_variance")
    assert some.parts is not None and some.parts.target_rotation is None and some.render.depth_sq is not None
    assert made("render", "art").parts.target_rotation is not None
    seldom = build("articulation", scene, views, ("render", "part"))
    seldom.losses["part"].start = 0.5
    assert seldom.inputs(visit(seldom)).parts is None


@pytest.mark.parametrize("name", ["single_state", "articulation"])
def test_same_bits_for_any_number_of_threads(name, scene, views, tmp_path):
    trained = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        phase = fit(build(name, scene, views), tmp_path / str(threads))
        assert torch.get_num_threads() == threads
        trained.append(list(phase.splats.parameters()))
    assert all(torch.equal(a, b) for a, b in zip(*trained, strict=True))


@pytest.mark.parametrize("name", ["single_state", "sharpen", "canonical_fusion", "articulation"])
def test_resume_is_bit_exact_across_densification(name, scene, views, tmp_path):
    densify = name != "sharpen"  # labels of discovery go by number
    whole = fit(build(name, scene, views), tmp_path / "whole", densify=densify)
    # killed: the newest checkpoint is of step 12
    fit(build(name, scene, views), tmp_path / "cut", until=14, densify=densify)
    resume = str(tmp_path / "cut" / "checkpoints" / f"{whole.phase_name}.ckpt")
    cut = fit(build(name, scene, views), tmp_path / "cut", resume=resume, densify=densify)
    assert whole.step == cut.step == 24
    first, second = whole.state_dict(), cut.state_dict()
    assert first.keys() == second.keys()
    for key in first:
        assert torch.equal(first[key], second[key]), key


def test_single_state_learns_the_image(scene, views, tmp_path):
    phase = build("single_state", scene, views)
    phase.config.steps = 150
    before = float(phase.total_loss(phase.inputs(visit(phase))).detach())
    fit(phase, tmp_path)
    assert float(phase.scalars["loss/total"]) < 0.6 * before


def test_sharpening_goes_over_to_other_pixels(scene, views, tmp_path):
    """The panels were photographed with classic pixels: drawn with sharp ones they look wrong until they have been
    fitted to them."""
    phase = build("sharpen", scene, views, rates=SplatRates(1e-4, 4e-6, 1e-2, 5e-2, 1e-3, 1e-2, 1e-3))
    phase.config.steps = 120
    before = phase.splats.tensors().clone()
    fit(phase, tmp_path, densify=False)
    after = phase.hand_over()

    def error(g, backend):
        shots = [views[1].get(i, 1, torch.ones(3)) for i in range(8)]
        return float(
            sum(
                (render_gaussians(g, s.camera, torch.ones(3), backend=backend).colour - s.image).square().mean()
                for s in shots
            )
        )

    assert phase.rasterizer == "auto:sharp" and after.state == 1 and len(after.gaussians) == len(before)
    assert error(before, "auto:classic") < error(before, "auto:sharp")
    assert error(after.gaussians, "auto:sharp") < 0.7 * error(before, "auto:sharp")


def test_without_sharpening_all_stages_draw_as_the_run_does():
    assert SharpenConfig(steps=0).backend("cpu") == "cpu"
    assert SharpenConfig(pixels="classic").backend("gsplat:sharp") == "gsplat:classic"


def test_articulation_pulls_a_wrong_screw_home(scene, views, tmp_path):
    phase = build("articulation", scene, views, rate_screws=3e-3, rate_screws_end=1e-4, screws_from=0.0)
    phase.config.steps = 120
    off = se3.from_screw(torch.tensor([0.0, 0.1, 1.0]), torch.tensor([0.4, 0.5, 0.0]), 0.56)
    phase.screws.xi.data[0] = se3.log(off)

    def error():
        return float(so3.rotation_angle(phase.screws.transforms()[1, :3, :3].double() @ hinge()[:3, :3].T)) * 57.3

    before = error()
    fit(phase, tmp_path, densify=False)
    assert before > 3 and error() < 0.5 * before


@pytest.mark.parametrize("left_out", ARTICULATION_LOSSES)
def test_each_loss_can_be_left_out(left_out, scene, views, tmp_path):
    phase = build("articulation", scene, views, chosen=[n for n in ARTICULATION_LOSSES if n != left_out])
    phase.config.steps = 2
    fit(phase, tmp_path, densify=False)
    assert f"loss/{left_out}" not in phase.scalars and phase.step == 2


def test_no_loss_at_all_is_told(scene, views):
    phase = build("single_state", scene, views)
    phase.losses = {}
    with pytest.raises(UserError, match="no loss applies"):
        phase.total_loss(phase.inputs(visit(phase)))


@pytest.mark.parametrize("init", ["identity", "random"])
def test_the_papers_starts_run(init, scene, views, tmp_path):
    phase = build("articulation", scene, views, init=init)
    phase.config.steps = 3
    fit(phase, tmp_path, densify=False)
    assert phase.hand_over().types == ["free"]


def test_hand_over_survives_the_disk(scene, views, tmp_path):
    result = build("articulation", scene, views).hand_over()
    handover.save(result, tmp_path / "a.pt", key="k")
    loaded, header = handover.load(tmp_path / "a.pt")
    assert header == {"key": "k"} and loaded.types == ["revolute"]
    assert torch.equal(loaded.probs, result.probs) and torch.equal(loaded.gaussians.sh, result.gaussians.sh)
    assert torch.allclose(loaded.transforms[0], hinge(), atol=1e-5)
    assert (
        loaded.part_ids == torch.as_tensor(states_and_motions()[1].labels[0])[: len(loaded.part_ids)]
    ).float().mean() > 0.9


def test_previews_are_pictures(scene, views):
    for name in ("single_state", "canonical_fusion", "articulation"):
        for picture in build(name, scene, views).preview([0.0, 1.0]).values():
            assert picture.dtype == torch.uint8 and picture.dim() == 3 and picture.float().std() > 1
