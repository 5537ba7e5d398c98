"""A part may take the static surface or the whole object where the energy falls."""

from types import SimpleNamespace

import torch

from p2gs.gaussians.handover import PartMotions
from p2gs.parts.expand import expand, expansions
from p2gs.types import GaussianTensors

WHOLE = ("took the static surface", "took the whole object")


def two_parts() -> PartMotions:
    labels = [torch.tensor([0, 0, 1, 1, 2]), torch.tensor([0, 1, 1, 2, 2])]
    T = torch.eye(4).double().repeat(2, 1, 1)
    T[:, 0, 3] = torch.tensor([0.1, 0.2]).double()
    return PartMotions(["prismatic", "prismatic"], T, torch.tensor([0.9, 0.5]), labels, [torch.ones(5)] * 2)


def test_expansions_are_each_parts_with_the_static_surface_and_with_everything():
    found = {(how, k): m for how, k, m in expansions(judge_by(len), two_parts())}
    assert found.keys() == {(how, k) for how in WHOLE for k in (0, 1)}
    assert found["took the static surface", 1].labels[0].tolist() == [2, 2, 1, 1, 2]
    whole = found["took the whole object", 1]
    assert (
        len(whole) == 1
        and bool((whole.transforms[0] == two_parts().transforms[1]).all())
        and float(whole.confidence[0]) == 0.5
    )
    assert all(bool((own == 1).all()) for own in whole.labels)


def judge_by(energy, share=0.2):
    """A judge by ``energy`` of five Gaussians a state, too few for a cut."""
    five = GaussianTensors(*(torch.zeros(5, *shape) for shape in ((3,), (4,), (3,), (), (1, 3))))
    states = [SimpleNamespace(state=s, gaussians=five) for s in (0, 1)]
    seen = [SimpleNamespace(kept=torch.ones(5, dtype=torch.bool), lit=five)] * 2
    return SimpleNamespace(
        states=states,
        seen=lambda motions: seen,
        gain=lambda tried, than: energy(than) - energy(tried),
        own_share=lambda tried, than: share,
        further=0.15,
    )


def test_the_expansion_of_lowest_energy_is_taken_and_none_that_is_higher():
    def static(m: PartMotions) -> float:
        return float(sum((own == 0).sum() for own in m.labels))

    motions, log = expand(judge_by(lambda m: static(m) + len(m)), two_parts())
    assert len(motions) == 1 and log == [
        {"change": "took the whole object", "part": 0, "own_share": 0.2, "energy": -4.0}
    ]
    start = two_parts()
    motions, log = expand(judge_by(lambda m: -static(m)), start)
    assert motions is start and log == []


def test_an_expansion_that_photographs_hardly_tell_is_not_taken():
    start = two_parts()
    motions, log = expand(judge_by(lambda m: float(sum((own == 0).sum() for own in m.labels)), share=0.1), start)
    assert motions is start and log == []
