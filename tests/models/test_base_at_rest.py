"""The states' misalignment, found on the base once the parts are known, and kept out of the joints."""

from dataclasses import replace

import pytest
import torch
from tiny import hinge, photographs, textured_panels

from p2gs.data.views import TrainingViews
from p2gs.gaussians.handover import Articulation, PartMotions, Registration, StateGaussians
from p2gs.models.base_at_rest import motion_of_base
from p2gs.models.finish import FinishConfig
from p2gs.models.registered import register_state
from p2gs.motion.joint_confidence import state_depth
from p2gs.motion.refine_motions import Judge
from p2gs.motion.screw_polish import PolishConfig
from p2gs.ops import se3
from p2gs.ops.carry import Parts, carry

SIZE = 96
# everything has a say: of these panels of thick blobs much reaches over its edge
POLISH = PolishConfig(steps=100, levels=[SIZE], level_starts=[0.0], min_margin=0.0, free_static=0.0)


def two_states(off: torch.Tensor):
    """A hinged panel and its base in both states, the end as a whole moved by ``off`` [4, 4], cameras not; photographs
    of both."""
    g, labels = textured_panels(1200)
    still = torch.eye(4, dtype=torch.float64)
    means, quats, sh = carry(g.means, g.quats, g.sh, Parts(labels), torch.stack([hinge()]))
    end = register_state(
        StateGaussians(1, replace(g, means=means, quats=quats, sh=sh)), Registration(off, torch.zeros(3))
    )
    states = [StateGaussians(0, g), end]
    views = {s: TrainingViews(photographs(x.gaussians, labels, still, 0, SIZE, 8), [SIZE], crop=False)
             for s, x in enumerate(states)}  # fmt: skip
    return states, labels, views


@pytest.mark.parametrize("size", [0.0, 0.006])
def test_what_is_left_between_the_states_is_found_on_the_base(size):
    off = se3.exp(size * torch.tensor([1.0, -0.5, 0.8, 0.6, -1.0, 0.4], dtype=torch.float64))
    states, labels, views = two_states(off)
    learned = Articulation(
        states[0].gaussians, torch.nn.functional.one_hot(labels, 2).float(), ["revolute"], (off @ hinge())[None],
        torch.ones(1), 0.0,
    )  # fmt: skip
    config = FinishConfig(polish=POLISH, clean_neighbours=0)
    base = motion_of_base(learned, states, views, config, 0, "auto", "cpu")
    points = states[0].gaussians.means.double()
    apart = float((se3.apply(base, points) - se3.apply(off, points)).norm(dim=1).mean())
    assert apart < 0.0015, apart
    if size:  # a fifth of what a joint would have had in it
        assert apart < 0.2 * float((se3.apply(off, points) - points).norm(dim=1).mean())


def test_a_part_that_was_explained_better_before_goes_back_alone():
    states, labels, views = two_states(torch.eye(4, dtype=torch.float64))
    labels = torch.where(
        (labels == 0) & (states[0].gaussians.means[:, 0] < states[0].gaussians.means[:, 0].mean()), 2, labels
    )
    still, margins = torch.eye(4, dtype=torch.float64), [torch.ones(len(labels))] * 2
    wrong = se3.exp(torch.tensor([0, 0, 0.05, 0.02, 0, 0], dtype=torch.float64))

    def bodies(first, second):
        return PartMotions(["free"] * 2, torch.stack([first, second]), torch.ones(2), [labels] * 2, margins)

    judge = Judge(None, states, views, POLISH, [state_depth(s, views[s.state], SIZE) for s in states], 0, "auto")
    kept = judge.no_worse(bodies(wrong @ hinge(), still), bodies(hinge(), wrong)).transforms
    assert torch.equal(kept[0], hinge()) and torch.equal(kept[1], still)
