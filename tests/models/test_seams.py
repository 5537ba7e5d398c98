"""Two parts that no edge parts in photographs are one body; what an edge parts stays two."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from p2gs.data.views import TrainingViews
from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.motion.screw_polish import PolishConfig
from p2gs.ops import se3
from p2gs.ops.sh import C0
from p2gs.parts import seams
from p2gs.parts.seams import EDGE, contrast_of, join_seamless, parted_by_an_edge, seamless
from p2gs.types import GaussianTensors
from tests.models.tiny import photographs

HALVES = np.arange(60)[None] < np.full((40, 1), 30)


def texture(strength: float) -> np.ndarray:
    return strength * np.random.default_rng(0).random((40, 60))


@pytest.mark.parametrize(
    ("strength", "rows", "parted"),
    [
        (0.05, slice(0, 0), False),  # plain, and no edge
        (0.05, slice(None), True),  # an edge all along
        (0.05, slice(20, None), False),  # they hang together where it ends
        (0.5, slice(0, 0), False),  # texture is no edge
        (0.5, slice(None), True),
    ],
)
def test_an_edge_parts_two_regions_where_it_runs_all_along(strength, rows, parted):
    contrast = texture(strength)
    contrast[rows, 29:31] += 1.0
    assert parted_by_an_edge(contrast, HALVES, ~HALVES) == parted
    assert parted_by_an_edge(contrast, ~HALVES, HALVES) == parted  # whichever comes first
    assert parted_by_an_edge(3 * contrast + 0.2, HALVES, ~HALVES) == parted  # however bright the photograph is


def test_a_border_beside_the_edge_parts_them_too():
    contrast = texture(0.05)
    contrast[:, 33:35] += 1.0  # labels end three pixels before it does
    assert parted_by_an_edge(contrast, HALVES, ~HALVES)


def test_contrast_is_the_range_around_a_pixel():
    image = torch.rand(20, 24, 3, generator=torch.Generator().manual_seed(0))
    smooth = torch.nn.functional.avg_pool2d(image.permute(2, 0, 1)[None], 3, 1)[0]  # without the rim
    for y, x in ((5, 6), (10, 12), (14, 17)):
        around = smooth[:, y - 1 - EDGE : y + EDGE, x - 1 - EDGE : x + EDGE].flatten(1)
        assert contrast_of(image)[y, x] == pytest.approx(float((around.amax(1) - around.amin(1)).mean()), abs=1e-6)


def plates(right: float) -> tuple[GaussianTensors, torch.Tensor]:
    """A plate of which the left half, label 1, is grey, and the right one, label 2, of brightness ``right``."""
    side = torch.linspace(-0.7, 0.7, 36)
    points = torch.cartesian_prod(side, side)
    means = torch.stack([torch.full((len(points),), 0.2), *points.T], 1)
    labels = torch.where(points[:, 0] < 0, 1, 2)
    colour = torch.where(labels == 2, right, 0.5)
    sh = ((colour - 0.5) / C0)[:, None, None].expand(-1, 1, 3).contiguous()
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(len(points), 1)
    scales = torch.tensor([0.004, 0.03, 0.03]).log().repeat(len(points), 1)
    return GaussianTensors(means, quats, scales, torch.full((len(points),), 4.0), sh), labels


@dataclass
class Told:
    """A judge that likes a small angle, and refines nothing. as_one: what surfaces say against a part less."""

    states: list
    views: dict
    as_one: float = 0.0
    backend: str = "auto"
    device: str = "cpu"
    config = PolishConfig()

    def gain(self, tried, than):
        return self.angle(than) - self.angle(tried)

    def refine(self, motions):
        return motions

    def surfaces(self, motions):
        return -self.as_one * len(motions)

    @staticmethod
    def angle(motions) -> float:
        return float(sum(se3.screw_parameters(T).angle.abs() for T in motions.transforms))


@pytest.mark.parametrize(("right", "parts"), [(0.5, 1), (0.9, 2)])
@pytest.mark.parametrize("smaller", [0, 1])
def test_a_plate_torn_in_two_becomes_one_with_the_better_motion(right, parts, smaller):
    g, labels = plates(right)
    still = torch.eye(4).double()
    views = {s: TrainingViews(photographs(g, labels, torch.stack([still, still]), s, 96), [96]) for s in (0, 1)}
    angles = (0.3, 0.4)[:: 1 if smaller == 0 else -1]
    T = torch.stack([se3.from_screw(torch.eye(3)[2].double(), still[:3, 3], torch.tensor(a).double()) for a in angles])
    motions = PartMotions(["revolute"] * 2, T, torch.ones(2), [labels] * 2, [torch.ones(len(labels))] * 2)
    judge = Told([StateGaussians(0, g), StateGaussians(1, g)], views)
    joined, log = join_seamless(judge, motions)
    assert len(joined) == parts
    shares = seamless(judge, motions)[0, 1]
    if parts == 1:
        assert torch.equal(joined.transforms[0], T[smaller])
        assert all(bool((of == 1).all()) for of in joined.labels)
        assert log == [{"parts": [0, 1], "without_edge": list(shares), "surfaces": 0.0, "joined": True}]
        assert min(shares) > 0.9
    else:
        assert joined is motions and log == [] and max(shares) < 0.2


def test_parts_that_only_one_state_shows_beside_each_other_stay_two():
    g, labels = plates(0.5)
    still = torch.eye(4).double()
    apart = still.clone()
    apart[1, 3] = 0.5
    views = {s: TrainingViews(photographs(g, labels, torch.stack([still, T]), s, 96), [96])
             for s, T in enumerate((still, apart))}  # fmt: skip
    there = g.means.clone()
    there[labels == 2] += apart[:3, 3]
    states = [StateGaussians(0, g), StateGaussians(1, replace(g, means=there))]
    motions = PartMotions(["prismatic"] * 2, torch.stack([still, apart]), torch.ones(2), [labels] * 2, [])
    judge = Told(states, views)
    assert seamless(judge, motions) == {}
    assert len(join_seamless(judge, motions)[0]) == 2


@pytest.mark.parametrize(("more", "parts"), [(0.1, 2), (0.0, 1), (-0.02, 1)])
def test_what_shows_no_edge_stays_two_where_surfaces_tell_it_apart(monkeypatch, more, parts):
    shares = {(0, 1): (1.0, 0.7), (1, 2): (0.9, 0.9), (0, 2): (0.2, 1.0)}  # nobody asks the last pair
    monkeypatch.setattr(seams, "seamless", lambda judge, motions: shares if len(motions) > 2 else {})
    turns = torch.stack([se3.from_screw(torch.eye(3)[2].double(), torch.zeros(3).double(), torch.tensor(a).double())
                         for a in (0.3, 0.4, 0.6)])  # fmt: skip
    labels = torch.tensor([0, 1, 2, 3])
    motions = PartMotions(["revolute"] * 3, turns, torch.ones(3), [labels] * 2, [torch.ones(4)] * 2)
    judge = Told([], {}, as_one=more)
    joined, log = join_seamless(judge, motions)
    assert [x["parts"] for x in log] == [[1, 2], [0, 1]][: 1 if parts == 1 else 2]  # fewest edges first
    assert [x["surfaces"] for x in log] == pytest.approx([more] * len(log))
    assert [x["joined"] for x in log] == [parts == 1] * len(log)
    if parts == 1:
        assert torch.equal(joined.transforms, turns[:2]) and joined.labels[0].tolist() == [0, 1, 2, 2]
    else:
        assert joined is motions


def test_what_was_split_without_a_gain_needs_an_edge_in_both_states(monkeypatch):
    """Of four slides two pairs are halves of one drawer each, as far as what is behind their fronts says."""
    shares = {
        4: {(0, 3): (0.5, 0.4), (1, 2): (0.4, 0.4)},  # the first shows no edge in half of the start's photographs
        3: {(1, 2): (0.4, 0.6), (0, 1): (0.9, 0.3)},
        2: {(0, 1): (0.6, 0.3)},
    }
    monkeypatch.setattr(seams, "seamless", lambda judge, motions: shares[len(motions)])
    slides = torch.eye(4).double().repeat(4, 1, 1)
    slides[:, 0, 3] = torch.tensor([0.1, 0.2, 0.3, 0.1])
    labels = torch.arange(5)
    motions = PartMotions(["prismatic"] * 4, slides, torch.ones(4), [labels] * 2, [torch.ones(5)] * 2)
    judge = Told([], {}, as_one=0.0)
    assert join_seamless(judge, motions)[0] is motions
    joined, log = join_seamless(judge, motions, [(0, 3), (1, 2)])
    assert [x["parts"] for x in log] == [[0, 3], [1, 2]] and all(x["joined"] for x in log)
    assert joined.labels[0].tolist() == [0, 1, 2, 2, 1] and len(joined) == 2  # the last pair was nobody's half
