"""Angles about a part's axis that photographs do not tell from the found one."""

import json
import math

import pytest
import torch
from tiny import photographs, textured_panels

from p2gs.data.views import TrainingViews
from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.gaussians.twin_json import read_twin_json, write_twin_json
from p2gs.models.finish import assemble
from p2gs.motion.alternatives import other_angles
from p2gs.motion.joint_confidence import state_depth
from p2gs.motion.refine_motions import Judge
from p2gs.motion.screw_polish import MovedGaussians, PolishConfig
from p2gs.ops import se3
from p2gs.types import GaussianTensors, Similarity

UP = torch.tensor([0.0, 0.0, 1.0]).double()


def cross(arms: list[float]) -> tuple[GaussianTensors, torch.Tensor]:
    """A textured panel (label 0) and over it a plain cross (label 1): arms at these angles (degrees) about the z axis
    through the origin."""
    g, labels = textured_panels()
    panel = g[labels == 0]
    along = torch.linspace(0.05, 0.5, 19)
    ways = torch.tensor([[math.cos(math.radians(a)), math.sin(math.radians(a)), 0.0] for a in arms])
    points = (along[:, None, None] * ways).reshape(-1, 3) + torch.tensor([0.0, 0.0, 0.55])
    n, plain = len(points), torch.tensor([1.2, -0.6, -1.0])
    arm = GaussianTensors(
        points, torch.eye(4)[:1].expand(n, 4), torch.full((n, 3), -3.4), torch.full((n,), 3.0), plain.expand(n, 1, 3)
    )
    return GaussianTensors.cat([panel, arm]), torch.cat([torch.zeros(len(panel)), torch.ones(n)]).long()


def angles(arms: list[float], angle: float = 30.0, kind: str = "revolute", told: float = 0.15) -> list[float]:
    """Degrees about the z axis of the alternatives to a turn by ``angle``."""
    g, labels = cross(arms)
    T = se3.from_screw(UP, torch.zeros(3).double(), math.radians(angle))
    means, quats, sh = MovedGaussians(g, labels).moved(T[None])
    states = [
        StateGaussians(0, g),
        StateGaussians(1, GaussianTensors(means, quats, g.log_scales, g.opacity_logits, sh)),
    ]
    ways = torch.eye(4).double(), T
    views = {s: TrainingViews(photographs(g, labels, ways[s], s), [64]) for s in (0, 1)}
    stacks = [state_depth(state, views[s], 64) for s, state in enumerate(states)]
    config = PolishConfig(levels=[64], level_starts=[0.0])
    judge = Judge(None, states, views, config, stacks, seed=0, backend="auto")
    motions = PartMotions([kind], T[None], torch.ones(1), [labels] * 2, [torch.ones(len(labels))] * 2)
    found = [se3.screw_parameters(other) for other in other_angles(judge, motions, told)[0]]
    return sorted(math.degrees(float(s.angle)) * float(s.axis[2].sign()) for s in found)


@pytest.mark.parametrize(
    ("arms", "others"), [([0, 90, 180, 270], [-150, -60, 120]), ([0, 180], [-150]), ([0, 80, 190], [])]
)
def test_a_cross_looks_alike_after_the_turns_that_lay_it_on_itself(arms, others):
    assert angles(arms) == pytest.approx(others, abs=2)


def test_slides_have_none_and_none_are_sought_where_nothing_is_asked():
    assert angles([0, 90, 180, 270], kind="prismatic") == []
    assert angles([0, 90, 180, 270], told=0.0) == []


def test_they_are_written_in_the_input_s_units_and_read_again(tmp_path):
    g, labels = cross([0, 180])
    here = torch.tensor([0.2, 0.0, 0.0]).double()
    T, other = (se3.from_screw(UP, here, math.radians(a)) for a in (30, -150))
    twin = assemble(g, labels, ["revolute"], T[None], 0.0, Similarity(2.0, (1.0, 0.0, 0.0)), [0.7], [[other]])
    write_twin_json(twin, tmp_path / "twin.json")
    written = json.loads((tmp_path / "twin.json").read_text())["parts"][1]
    assert written["confidence"] == 0.7 and len(written["alternatives"]) == 1
    base, part = read_twin_json(tmp_path / "twin.json")[0]
    assert base.alternatives == () and part.alternatives[0].motion == pytest.approx(150)
    assert part.alternatives[0].axis.tolist() == pytest.approx([0, 0, -1])
    assert part.alternatives[0].origin[:2].tolist() == pytest.approx([1.1, 0]) == part.joint.origin[:2].tolist()
    del written["alternatives"]  # as older twins have it
    (tmp_path / "twin.json").write_text(
        json.dumps({"format": "p2gs-twin/1", "canonical_time": 0.0, "parts": [{"id": 0, "kind": "static"}, written]})
    )
    assert read_twin_json(tmp_path / "twin.json")[0][1].alternatives == ()
