"""The best explanation takes parts of others, with their Gaussians, where the energy falls."""

from types import SimpleNamespace

import pytest
import torch

from p2gs.gaussians.handover import PartMotions
from p2gs.parts.fuse import fuse, with_part_of
from p2gs.types import GaussianTensors


def explanation(slides: list[float], start: list[int], end: list[int]) -> PartMotions:
    """Six Gaussians a state; part k + 1 slides along the k-th axis."""
    T = torch.eye(4).double().repeat(len(slides), 1, 1)
    for k, far in enumerate(slides):
        T[k, k, 3] = far
    labels, margin = [torch.tensor(start), torch.tensor(end)], [torch.full((6,), 0.1 * len(slides))] * 2
    return PartMotions(["prismatic"] * len(slides), T, torch.full((len(slides),), 0.7), labels, margin)


def chosen() -> PartMotions:
    return explanation([0.1], [0, 0, 1, 1, 1, 0], [0, 0, 1, 1, 1, 1])


def other() -> PartMotions:
    """Its first part is the chosen's, a little off; its second goes another way."""
    return explanation([0.11, 0.4], [0, 0, 1, 1, 2, 2], [0, 2, 1, 1, 2, 0])


def judge_by(energy, share=0.2):
    six = GaussianTensors(*(torch.zeros(6, *shape) for shape in ((3,), (4,), (3,), (), (1, 3))))
    return SimpleNamespace(
        states=[SimpleNamespace(state=s, gaussians=six) for s in (0, 1)],
        seen=lambda motions: None,
        gain=lambda tried, than: energy(than) - energy(tried),
        own_share=lambda tried, than: share,
        improved=lambda motions: (0.0, 0.0, motions),
        further=0.15,
    )


def more_is_better(motions: PartMotions) -> float:
    return -float(len(motions))


def test_a_part_comes_with_its_gaussians_and_what_is_known_of_them():
    fused = with_part_of(chosen(), other(), 1)
    assert fused.types == ["prismatic"] * 2 and float(fused.transforms[1, 1, 3]) == 0.4
    assert fused.labels[0].tolist() == [0, 0, 1, 1, 2, 2] and fused.labels[1].tolist() == [0, 2, 1, 1, 2, 1]
    assert fused.margin[1].tolist() == pytest.approx([0.1, 0.2, 0.1, 0.1, 0.2, 0.1])
    assert fused.confidence.tolist() == pytest.approx([0.7, 0.7])


def test_the_part_that_lowers_the_energy_is_taken_and_one_that_is_there_is_not_asked():
    asked = []
    judge = judge_by(more_is_better)
    gain = judge.gain
    judge.gain = lambda tried, than: asked.append(tried) or gain(tried, than)
    motions, log = fuse(judge, chosen(), [chosen(), other()], 5, 0.04)
    assert len(motions) == 2 and float(motions.transforms[1, 1, 3]) == 0.4
    assert log == [
        {"change": "fused", "explanation": 1, "part": 1, "type": "prismatic", "energy": -1.0, "own_share": 0.2}
    ]
    assert all(len(tried) == 2 for tried in asked)  # neither part that goes by 0.1 or 0.11, nor the taken one again


def test_nothing_is_taken_that_raises_the_energy_or_saves_little_in_its_own_pixels():
    start = chosen()
    motions, log = fuse(judge_by(lambda m: float(len(m))), start, [other()], 5, 0.04)
    assert motions is start and log[0]["energy"] == 1.0 and "own_share" not in log[0]
    motions, log = fuse(judge_by(more_is_better, share=0.1), start, [other()], 5, 0.04)
    assert motions is start and log[0]["own_share"] == 0.1


def test_where_the_part_of_least_energy_saves_little_the_next_one_is_asked():
    judge = judge_by(lambda m: -float(m.transforms[-1].abs().max()))
    judge.own_share = lambda tried, than: 0.1 if float(tried.transforms[-1].abs().max()) > 2 else 0.2
    far = explanation([0.11, 3.0], [0, 0, 1, 1, 2, 2], [0, 2, 1, 1, 2, 0])
    near = explanation([0.11, 2.0], [0, 0, 1, 1, 2, 2], [0, 2, 1, 1, 2, 0])
    motions, log = fuse(judge, chosen(), [far, near], 2, 0.04)
    assert [(told["explanation"], told["own_share"]) for told in log] == [(0, 0.1), (1, 0.2)]
    assert float(motions.transforms[1, 1, 3]) == 2.0


def test_there_are_no_more_parts_than_asked_for():
    start = chosen()
    assert fuse(judge_by(more_is_better), start, [other()], 1, 0.04) == (start, [])
