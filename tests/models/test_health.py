"""A loss that stops being finite, a state that loses its Gaussians, a result with NaN: a sentence, and the last good
state on disk."""

import pytest
import torch
from lightning.pytorch import Trainer
from tiny import TinyData, hinge, random_gaussians, tiny_scene

from p2gs.callbacks.base import Callback
from p2gs.callbacks.checkpoint import Checkpoint
from p2gs.callbacks.densify import Densify
from p2gs.data.views import TrainingViews
from p2gs.losses.base import LOSSES, Loss
from p2gs.models.health import LossNotFinite, check_result
from p2gs.models.single_state import SingleStateConfig, SingleStatePhase
from p2gs.types import UserError


@pytest.fixture(scope="module")
def scene():
    return tiny_scene(hinge())


def phase_of(scene, steps=12, **extra):
    config = SingleStateConfig(steps=steps, initial_gaussians=100, levels=[24], level_starts=[0.0])
    views = TrainingViews(scene.select(state=0), [24])
    return SingleStatePhase(config, {"render": LOSSES["render"](), **extra}, scene, 0, views, seed=3)


def fit(phase, folder, *callbacks, until=None):
    steps = until or phase.total_steps
    options = {
        "logger": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
        "enable_checkpointing": False,
    }
    trainer = Trainer(
        max_steps=steps, max_epochs=-1, accelerator="cpu", callbacks=list(callbacks), default_root_dir=folder, **options
    )
    trainer.fit(phase, datamodule=TinyData())
    return phase


class Breaks(Loss):
    """Finite up to a step, then not."""

    def __init__(self, value):
        super().__init__()
        self.value = value

    def compute(self, inputs):
        return inputs.gaussians.means.sum() * (self.value if inputs.step >= 7 else 0.0)


class Damage(Callback):
    """Does something to the phase after a number of steps."""

    changes_result = False

    def __init__(self, after, harm):
        self.after, self.harm = after, harm

    def on_step(self, trainer, phase):
        if phase.step == self.after:
            self.harm(phase)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_loss_that_is_not_finite_stops_with_the_last_good_state(scene, tmp_path, value):
    phase = phase_of(scene, odd=Breaks(value))
    with pytest.raises(LossNotFinite) as raised:
        fit(phase, tmp_path, Checkpoint(every=5))
    said = str(raised.value)
    assert (
        "not finite at step 7" in said
        and "odd is" in said
        and "phases.single_state.losses.odd" in said
        and "\n" not in said
    )
    stored = torch.load(tmp_path / "checkpoints" / "single_state.ckpt", weights_only=True)
    good = fit(phase_of(scene), tmp_path / "other", until=7)  # never had that loss
    assert stored["global_step"] == 7
    for name, tensor in good.state_dict().items():
        assert torch.equal(stored["state_dict"][name], tensor), name


def test_a_state_that_is_not_good_replaces_no_checkpoint(scene, tmp_path):
    """One Gaussian was NaN before the loss was: the checkpoint of step 5 is better than that."""

    def harm(phase):
        phase.splats.means.data[3] = torch.nan

    with pytest.raises(LossNotFinite):
        fit(phase_of(scene, odd=Breaks(1.0)), tmp_path, Damage(6, harm), Checkpoint(every=5))
    assert torch.load(tmp_path / "checkpoints" / "single_state.ckpt", weights_only=True)["global_step"] == 5


def test_a_state_whose_last_gaussian_is_pruned_says_so(scene, tmp_path):
    def harm(phase):
        phase.splats.means.data.fill_(torch.inf)  # what densify removes as garbage

    with pytest.raises(UserError, match="single_state: the reconstruction has collapsed, no Gaussian is left"):
        fit(phase_of(scene), tmp_path, Damage(4, harm), Densify(budget=200, every=4, start=0.0, stop=1.0))


def test_a_state_that_no_view_sees_says_so(scene):
    phase = phase_of(scene)
    phase.splats.means.data += 100.0
    with pytest.raises(UserError, match="collapsed, no Gaussian is left of 100, no training view sees any"):
        phase.hand_over()


@pytest.mark.parametrize("field", ["means", "log_scales", "sh"])
def test_a_result_with_nan_is_not_kept(field):
    from p2gs.gaussians.handover import StateGaussians

    state = StateGaussians(0, random_gaussians(20))
    check_result("single_state_0", state)
    getattr(state.gaussians, field).data[7, 0] = torch.nan
    with pytest.raises(UserError, match=f"single_state_0: [13] of .* its result's '{field}' are not finite"):
        check_result("single_state_0", state)
