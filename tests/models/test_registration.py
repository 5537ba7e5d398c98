"""The end state in the start's frame: the base's small motion found beside what really moved, applied only where
photographs say so."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny import photographs, textured_panels

from p2gs.data.exposure import brightened, corrected, encoded, linear, median_gain
from p2gs.data.views import TrainingViews
from p2gs.gaussians.frame import camera_to_input
from p2gs.gaussians.handover import Registration, StateGaussians, ViewCorrections
from p2gs.models.registered import (
    as_fitted,
    correct_scene,
    dimmed,
    read_registration,
    register_state,
    register_views,
    write_registration,
)
from p2gs.models.registration import Pair, RegistrationConfig, align_states
from p2gs.models.trial import held_out, trial
from p2gs.motion.surface_fit import fit_surfaces
from p2gs.ops import se3
from p2gs.ops.sh import dc_to_rgb
from p2gs.types import Similarity, TwoStateScene
from p2gs.visibility.evidence import gather_evidence
from p2gs.visibility.surfels import Surfels

BESIDE = se3.exp(torch.tensor([0.003, -0.004, 0.002, 0.012, -0.008, 0.01]).double())  # 0.3 degrees, 0.018 of a box of 2


def degrees(T: torch.Tensor) -> float:
    return float(torch.rad2deg(((T[:3, :3].trace() - 1) / 2).clamp(-1, 1).acos()))


def face(normal: tuple, at: tuple, u: tuple, v: tuple, n: int, gen) -> tuple[torch.Tensor, torch.Tensor]:
    """n random points of a rectangle about ``at`` spanned by u and v, and its normal."""
    s = 2 * torch.rand(n, 2, generator=gen) - 1
    return torch.tensor(at) + s[:, :1] * torch.tensor(u) + s[:, 1:] * torch.tensor(v), torch.tensor(normal).expand(n, 3)


def cupboard(open_by: float, noise: float, seed: int) -> Surfels:
    """A box of 1 x 0.8 x 1.2 without front, and a front plate that turns about its left edge by ``open_by`` radians."""
    gen = torch.Generator().manual_seed(seed)
    x, y, z = 0.5, 0.4, 0.6
    sides = [
        face((-1.0, 0, 0), (-x, 0.0, 0), (0.0, y, 0), (0.0, 0, z), 1600, gen),
        face((1.0, 0, 0), (x, 0.0, 0), (0.0, y, 0), (0.0, 0, z), 1600, gen),
        face((0.0, 0, 1), (0.0, 0, z), (x, 0.0, 0), (0.0, y, 0), 1300, gen),
        face((0.0, 1, 0), (0.0, y, 0), (x, 0.0, 0), (0.0, 0, z), 2000, gen),
    ]
    front, out = face((0.0, -1, 0), (0.0, -y, 0), (x, 0.0, 0), (0.0, 0, z), 2000, gen)
    turn = se3.from_screw(torch.tensor([0.0, 0, 1]).double(), torch.tensor([-x, -y, 0]).double(), -open_by)
    sides.append((se3.apply(turn, front.double()).float(), (out.double() @ turn[:3, :3].T).float()))
    points, normals = torch.cat([p for p, _ in sides]), torch.cat([n for _, n in sides])
    points = points + normals * noise * torch.randn(len(points), 1, generator=gen)
    return Surfels(points, normals, torch.zeros_like(points), 0.025, noise)


@pytest.mark.parametrize("open_by, limit", [(0.05, 0.15), (0.3, 0.06), (1.2, 0.06)])
def test_surfaces_ignore_the_door(open_by, limit):
    """Also a door that is only ajar, by three degrees: next to its hinge it has not moved farther than the surfaces'
    noise. Photographs take it from here."""
    start, end = cupboard(0.0, 0.002, 1), cupboard(open_by, 0.002, 2)
    back = se3.inverse(BESIDE)
    end.points, end.normals = (
        se3.apply(back, end.points.double()).float(),
        (end.normals.double() @ back[:3, :3].T).float(),
    )
    found = fit_surfaces(end, start, 0.06)
    left = se3.inverse(BESIDE) @ found.transform
    assert degrees(left) < limit and left[:3, 3].norm() < 1e-3
    assert 0.6 < found.share < 0.95 and found.spread > 0.2


def test_gains_of_linear_light():
    photo = (torch.rand(40, 40, 3, generator=torch.Generator().manual_seed(0)) * 0.6 + 0.2) * 255
    gain = np.array([0.16, 0.0, -0.1])
    bright = np.rint(255 * encoded(linear(photo.round().numpy() / 255) * np.exp(gain))).astype(np.uint8)
    assert np.abs(corrected(bright, gain).astype(int) - photo.round().numpy()).max() <= 1
    inside = torch.ones(40, 40, dtype=torch.bool)
    told = median_gain(torch.from_numpy(bright) / 255, photo.round() / 255, inside)
    assert torch.allclose(told, torch.tensor(gain).float(), atol=4e-3)
    assert torch.allclose(brightened(photo / 255, torch.tensor(gain)), torch.from_numpy(bright) / 255, atol=4e-3)
    assert median_gain(torch.zeros(40, 40, 3), photo / 255, inside) is None  # too dark to tell


def test_trial_wants_size_and_certainty():
    gen = torch.Generator().manual_seed(0)
    errors = 0.02 + 0.005 * torch.rand(16, generator=gen)
    assert trial(errors, 0.9 * errors).passed(0.02)
    assert not trial(errors, 0.99 * errors).passed(0.02)  # certain but small
    assert not trial(errors, errors * (1 + 0.3 * torch.randn(16, generator=gen))).passed(0.02)  # noise
    kept, out = held_out(10)
    assert sorted(kept + out) == list(range(10)) and len(out) == 2


TURN = se3.from_screw(torch.tensor([0.0, 0, 1]).double(), torch.tensor([0.4, 0.5, 0]).double(), 0.6)


def panels(dim: float, beside: torch.Tensor, motion=TURN, g=None) -> tuple[list[StateGaussians], TwoStateScene]:
    """Two perfect states, one panel's ``motion`` (0.6 radians) apart; the end's world lies ``beside`` the start's and
    is exp(dim) as bright."""
    drawn, labels = textured_panels(1500)
    g = drawn if g is None else g
    views, states = [], []
    for state, T in enumerate((torch.eye(4).double(), motion)):
        shots = photographs(g, labels, T, state, 96, 12)
        moved = register_state(StateGaussians(1, g), Registration(T, torch.zeros(3))).gaussians
        own = type(g)(
            *(
                torch.where((labels == 1).view(-1, *[1] * (getattr(g, n).dim() - 1)), getattr(moved, n), getattr(g, n))
                for n in g.NAMES
            )
        )
        states.append(StateGaussians(state, own))
        views += shots
    apart = Registration(se3.inverse(beside), torch.full((3,), -dim))
    return [states[0], register_state(states[1], apart)], register_views(TwoStateScene("panels", tuple(views)), apart)


def aligned(states, scene, say=None) -> Registration:
    views = {s: TrainingViews(scene.select(state=s), [96], crop=False) for s in (0, 1)}
    evidence = [gather_evidence(s.gaussians, scene.select(state=s.state), 96, 0.1) for s in states]
    box = torch.tensor([[-0.6, -0.3, -0.6], [0.8, 1.0, 0.6]])
    return align_states(states, evidence, views, box, RegistrationConfig(levels=[96]), report=say)


def test_misaligned_and_darker():
    said = []
    states, scene = panels(-0.16, BESIDE)
    found = aligned(states, scene, said.append)
    still = textured_panels(1500)[0].means[::2].double()  # one thin panel is all that stayed
    off, left = (
        float((se3.apply(T, still) - still).norm(dim=1).mean()) for T in (BESIDE, se3.inverse(BESIDE) @ found.transform)
    )
    assert left < 0.2 * off, (left, off, said)
    assert torch.allclose(found.log_gain, torch.full((3,), -0.16), atol=0.03)
    assert found.figures["motion"]["applied"] and found.figures["gain"]["applied"] and len(said) == 2


def test_aligned_states_stay():
    states, scene = panels(0.0, torch.eye(4).double())
    found = aligned(states, scene)
    assert found.is_identity and register_state(states[1], found) is states[1] and register_views(scene, found) is scene


def push(x: float, z: float) -> torch.Tensor:
    T = torch.eye(4).double()
    T[:3, 3] = torch.tensor([x, 0.0, z])
    return T


def test_what_moved_as_one_and_far_is_no_other_frame():
    """Both panels 0.15 beside their places: as one rigid motion explains all, but captures are not that far apart."""
    said: list[str] = []
    states, scene = panels(0.0, push(-0.15, 0.0))
    found = aligned(states, scene, said.append)
    trial_of = found.figures["motion"]
    assert trial_of["better"] > 0.3 and trial_of["certain"] > 3  # photographs alone would have it
    assert found.is_identity and not trial_of["applied"] and "taken for a part" in said[0]


def test_a_slide_along_the_base_is_no_other_frame():
    """A textured panel slides along its normal, and along a plain one. Where nothing moved if the whole end did is the
    textured panel and the plain one's middle, which cannot tell; the plain one's edges are only among the pixels where
    nothing moved if it did not."""
    g, labels = textured_panels(1500)
    sideways = g.means[:, [1, 0, 2]] + torch.tensor([-0.5, 0.5, 0.0])
    plain = replace(
        g,
        sh=torch.where((labels == 0)[:, None, None], 0.6, g.sh),
        means=torch.where((labels == 1)[:, None], sideways, g.means),
    )
    still, slid = torch.eye(4).double(), push(0.06, 0.0)
    states, scene = panels(0.0, still, slid, plain)
    views = {s: TrainingViews(scene.select(state=s), [96], crop=False) for s in (0, 1)}
    pair = Pair(states[0].gaussians, states[1].gaussians, views, 0.01, "auto")
    picks, back = [list(range(12))] * 2, se3.inverse(slid)
    gained, lost = (pair.tried(picks, 96, *pair_of, torch.zeros(3)) for pair_of in ((still, back), (back, still)))
    assert gained.passed(0.02) and lost.better > 0, (gained, lost)
    assert aligned(states, scene).is_identity


def test_never():
    found = align_states([], [], {}, torch.zeros(2, 3), RegistrationConfig(motion="never", gain="never"))
    assert found.is_identity


def test_dimmed_gaussians():
    g, _ = textured_panels(50)
    half = dimmed(g, torch.full((3,), -0.7))
    want = torch.from_numpy(encoded(linear(dc_to_rgb(g.sh[:, 0]).clamp(0, 1).numpy()) * np.exp(-0.7))).float()
    seen = (dc_to_rgb(g.sh[:, 0]) > 0) & (dc_to_rgb(g.sh[:, 0]) < 1)
    assert torch.allclose(dc_to_rgb(half.sh[:, 0])[seen], want[seen], atol=1e-4)


def test_kept_in_the_inputs_coordinates(tmp_path):
    """The photographs of a run, read anew and corrected by its file, see what training saw."""
    similarity = Similarity(2.5, (0.3, -1.0, 2.0))
    inner = TwoStateScene("panels", panels(0.0, torch.eye(4).double())[1].views[::4], similarity)
    states = [StateGaussians(s, None, corrections(len(inner.select(s)), s)) for s in (0, 1)]
    found = Registration(BESIDE, torch.tensor([0.1, 0.2, 0.3]), {"share": 0.7})
    write_registration(tmp_path / "registration.json", found, states, inner)
    outer = inner.with_views(replace(v, camera=camera_to_input(v.camera, similarity)) for v in inner.views)
    for want, got in zip(
        register_views(correct_scene(inner, states), found).views, as_fitted(outer, tmp_path).views, strict=True
    ):
        assert torch.allclose(camera_to_input(want.camera, similarity).viewmat, got.camera.viewmat, atol=1e-5)
        assert torch.equal(want.image, got.image) and torch.equal(want.alpha, got.alpha)
    assert read_registration(tmp_path / "registration.json")[0].figures == {"share": 0.7}
    assert as_fitted(outer, tmp_path / "none") is outer


def corrections(count: int, seed: int) -> ViewCorrections:
    gen = torch.Generator().manual_seed(seed)
    return ViewCorrections(
        se3.exp(0.01 * torch.randn(count, 6, generator=gen).double()),
        0.1 * torch.randn(count, 3, generator=gen),
        0.02 * torch.randn(count, generator=gen).double(),
    )
