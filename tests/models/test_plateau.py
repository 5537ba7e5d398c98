"""Steps left out at a photograph's plateau: which, how many, and the same ones after a resume."""

import pytest
import torch
from lightning.pytorch import Trainer
from tiny import TinyData, hinge, tiny_scene

from p2gs.callbacks.base import Callback
from p2gs.data.views import TrainingViews
from p2gs.losses.base import LOSSES
from p2gs.models.plateau import MEMORY, Plateau, SkipConfig
from p2gs.models.single_state import SingleStateConfig, SingleStatePhase
from p2gs.types import UserError


def plain(losses, views, least):
    """The rule, written out."""
    mean, out, skipped = {}, [], 0
    for i, (view, loss) in enumerate(zip(views, losses, strict=True)):
        before = mean.get(view)
        skip = before is not None and loss <= before and skipped < (1 - least) * (i + 1)
        mean[view] = loss if before is None else MEMORY * before + (1 - MEMORY) * loss
        out.append(skip)
        skipped += skip
    return out


@pytest.mark.parametrize("least", [0.3, 0.5, 0.9])
def test_the_rule(least):
    gen = torch.Generator().manual_seed(1)
    losses, views = torch.rand(300, generator=gen).tolist(), torch.randint(7, (300,), generator=gen).tolist()
    plateau = Plateau(SkipConfig(0.0, least), 7)
    found = [plateau.skips(0.5, v, x) for v, x in zip(views, losses, strict=True)]
    assert found == plain(losses, views, least) and 0 < sum(found) <= (1 - least) * 300 + 1


def test_nothing_is_left_out_by_default_or_before_its_start():
    assert not any(Plateau(SkipConfig(), 1).skips(0.9, 0, x) for x in (3.0, 2.0, 1.0))
    late = Plateau(SkipConfig(0.6, 0.1), 1)
    assert not any(late.skips(0.5, 0, x) for x in (3.0, 2.0, 1.0)) and bool(late.means.isinf().all())


@pytest.mark.parametrize("values", [(0.6, 0.0), (1.5, 0.5), (0.6, 1.1)])
def test_mistakes_are_told(values):
    with pytest.raises(UserError, match="skip: expected"):
        SkipConfig(*values)


class Steps(Callback):
    changes_result = False

    def __init__(self, stop=None):
        self.stop, self.means = stop, []

    def on_step(self, trainer, phase):
        self.means.append(phase.splats.means.detach().clone())
        if phase.step == self.stop:
            trainer.save_checkpoint(trainer.default_root_dir + "/half.ckpt")
            trainer.should_stop = True


def fit(scene, folder, least, stop=None, ckpt=None):
    skip = SkipConfig(0.3, least)
    config = SingleStateConfig(steps=60, initial_gaussians=80, levels=[24], level_starts=[0.0], skip=skip)
    views = TrainingViews(scene.select(state=0), [24])
    phase = SingleStatePhase(config, {"render": LOSSES["render"]()}, scene, 0, views, seed=3)
    quiet = ("logger", "enable_progress_bar", "enable_model_summary", "enable_checkpointing")
    steps = Steps(stop)
    options = {"max_steps": 60, "max_epochs": -1, "accelerator": "cpu", "default_root_dir": str(folder)}
    trainer = Trainer(callbacks=[steps], **options, **{name: False for name in quiet})
    trainer.fit(phase, datamodule=TinyData(), ckpt_path=ckpt)
    return phase, steps.means


def test_a_step_that_is_left_out_changes_nothing_and_a_resume_leaves_out_the_same(tmp_path):
    scene = tiny_scene(hinge())
    whole, means = fit(scene, tmp_path, 0.5)
    still = sum(torch.equal(a, b) for a, b in zip(means, means[1:], strict=False))
    assert whole.global_step == 60 and still == int(whole.plateau.counts[1]) > 5
    fit(scene, tmp_path, 0.5, stop=40)
    resumed, _ = fit(scene, tmp_path, 0.5, ckpt=str(tmp_path / "half.ckpt"))
    assert torch.equal(resumed.plateau.counts, whole.plateau.counts)
    assert torch.equal(resumed.splats.means, whole.splats.means)
