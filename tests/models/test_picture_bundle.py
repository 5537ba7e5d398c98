"""Cameras found by all pixels at once: the linear model against finite differences, and small errors undone."""

from dataclasses import replace

import pytest
import torch
from tiny import look_at, photographs, textured_panels

from p2gs.data.views import TrainingViews
from p2gs.gaussians.handover import ViewCorrections
from p2gs.models.picture_bundle import _most_likely, _own_errors, _variances, adjust_pictures
from p2gs.models.registered import correct_views
from p2gs.motion.on_grey import photograph
from p2gs.motion.picture_steps import SHIFT, TWIST, picture_steps, steepest
from p2gs.ops import se3, so3
from p2gs.ops.robust import weighted_median
from p2gs.types import Camera

SIZE = 64


def scene(count: int = 8):
    g, labels = textured_panels(1200)
    return g, photographs(g, labels, torch.eye(4).double(), 0, SIZE, count)


def shot_of(views, index: int = 0):
    return photograph(TrainingViews(views, [SIZE], crop=False), index, SIZE, "cpu")


def pixels(camera: Camera, viewmat: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    seen = (points @ viewmat[:3, :3].T + viewmat[:3, 3]) @ camera.K.double().T
    return seen[:, :2] / seen[:, 2:]


def test_moves_are_the_projections_derivatives():
    g, views = scene()
    shot = shot_of(views)
    steps = picture_steps(g, shot, "auto")
    V, h = shot.camera.viewmat.double(), 1e-6
    here = pixels(shot.camera, V, steps.points)
    assert (here.frac() - 0.5).abs().max() < 1e-5  # the points that pixels' centres show
    for k in range(6):
        turned = pixels(shot.camera, V @ se3.exp(h * torch.eye(6).double()[k]), steps.points)
        assert torch.allclose((turned - here) / h, steps.moves[..., TWIST][..., k], atol=1e-3)
    for k in range(3):
        shifted = pixels(shot.camera, V, steps.points + h * torch.eye(3).double()[k])
        assert torch.allclose((shifted - here) / h, steps.moves[..., SHIFT][..., k], atol=1e-3)


def test_totals_are_sums_of_outer_products():
    g, views = scene(2)
    steps = picture_steps(g, shot_of(views), "auto")
    n, group = len(steps.points), torch.arange(len(steps.points)) % 3
    each = [
        (steps.moves[i].T @ steps.H[i] @ steps.moves[i], steps.moves[i].T @ steps.pull[i]) for i in range(n)
    ]  # the readable twin
    normal, right = steps.total()
    assert torch.allclose(normal, sum(a for a, _ in each)) and torch.allclose(right, sum(b for _, b in each))
    normals, rights = steps.totals(group, 3)
    for k in range(3):
        assert torch.allclose(normals[k], sum(each[i][0] for i in range(k, n, 3)))
        assert torch.allclose(rights[k], sum(each[i][1] for i in range(k, n, 3)))


def test_one_camera_is_put_right():
    """From half a pixel off to a fiftieth, by ten steps of Gauss and Newton."""
    g, views = scene()
    shot = shot_of(views)
    true = shot.camera.viewmat.double()
    begin = V = true @ se3.exp(torch.tensor([0.012, -0.009, 0.006, 0.018, -0.012, 0.015]).double())
    for _ in range(10):
        at = replace(shot, camera=replace(shot.camera, viewmat=V.float()))
        normal, right = picture_steps(g, at, "auto").total()
        V = V @ se3.exp(torch.linalg.solve(normal[TWIST, TWIST], right[TWIST]))
    points = g.means.double()
    first, last = ((pixels(shot.camera, X, points) - pixels(shot.camera, true, points)).norm(dim=1) for X in (begin, V))
    assert first.mean() > 0.4 and last.mean() < 0.02, (first.mean(), last.mean())


def test_all_cameras_at_once():
    """Cameras off by a pixel, the model true: three rounds leave less than a twentieth, and the mean where it was."""
    g, views = scene()
    ways = torch.stack([_own_errors(view.camera) for view in views])
    own = 0.01 * torch.randn(len(views), 6, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    twists = torch.linalg.solve(ways, own)[..., 0]
    twists -= twists.mean(0)
    shots = correct_views(views, ViewCorrections(se3.exp(twists), torch.zeros(len(views), 3), torch.zeros(len(views))))
    photos, found = [shot_of(shots, k) for k in range(len(shots))], torch.zeros(len(views), 6).double()
    for _ in range(3):
        known = [
            replace(p, camera=replace(p.camera, viewmat=(p.camera.viewmat.double() @ se3.exp(x)).float()))
            for p, x in zip(photos, found, strict=True)
        ]
        found = adjust_pictures(g, known, found, "auto")
        assert found.mean(0).abs().max() < 1e-12
    left = se3.log(se3.exp(twists) @ se3.exp(found))
    assert (left - left.mean(0)).norm() < 0.05 * twists.norm()


def looking_in(count: int) -> list[torch.Tensor]:
    """``_own_errors`` of cameras all around, at 2.5 and 3."""
    rng = torch.Generator().manual_seed(2)
    places = torch.nn.functional.normalize(torch.randn(count, 3, generator=rng), dim=1)
    return [_own_errors(look_at((2.5 + k % 2 / 2) * place, SIZE)) for k, place in enumerate(places)]


def test_a_cameras_own_errors_are_its_turn_and_its_centres_way():
    camera, twist = look_at(torch.tensor([1.5, -2.0, 1.0]), SIZE), 1e-6 * torch.randn(6).double()
    V = camera.viewmat.double()
    W = V @ se3.exp(twist)
    centres = [-(X[:3, :3].T @ X[:3, 3]) for X in (V, W)]
    turn, way = (_own_errors(camera) @ twist).split(3)
    assert torch.allclose(turn, so3.matrix_to_rotvec(V[:3, :3].T @ W[:3, :3]), atol=1e-11)
    assert torch.allclose(way, (centres[1] - centres[0]) / centres[0].norm(), atol=1e-11)


@pytest.mark.parametrize("s, k", [(0.002, 1.0), (0.002, 0.01), (0.0005, 0.1)])
def test_how_far_off_cameras_are_and_what_a_pixel_counts_is_found(s, k):
    """Pixels that say a turn and a step aside apart only roughly, with errors of their own: both variances come out,
    and cameras come out two and a half times nearer than by pixels alone, twenty times where pixels count little."""
    rng, count = torch.Generator().manual_seed(0), 60
    ways = torch.stack(looking_in(count))
    true = torch.linalg.solve(ways, s * torch.randn(count, 6, 1, generator=rng, dtype=torch.float64))[..., 0]
    A, found = torch.zeros(6 * count, 6 * count).double(), torch.zeros(count, 6).double()
    for i in range(count):
        moves = torch.randn(40, 6, generator=rng, dtype=torch.float64)
        moves = moves[:, :1] * ways[i, :1] + 0.003 * moves  # next to all pixels see one mixture of both
        mine = slice(6 * i, 6 * i + 6)
        A[mine, mine] = 1e8 * moves.T @ moves
        L = torch.linalg.cholesky(A[mine, mine])
        noise = torch.linalg.solve_triangular(L.T, torch.randn(6, 1, generator=rng, dtype=torch.float64), upper=True)
        found[i] = true[i] + noise[:, 0] / k**0.5
    known = 0.5 * true.roll(1, 0)  # whatever is known by now
    b = (A @ (found - known).flatten()[:, None])[:, 0]
    told = _most_likely(A, b, known, ways)
    own = [(ways @ (x - true + true.mean(0))[..., None]).norm() for x in (told, found)]
    assert told.mean(0).abs().max() < 1e-12
    assert float(own[0]) < (0.4 if k == 1 else 0.05) * float(own[1]), own
    back = torch.block_diag(*torch.linalg.inv(ways))
    a, axes = torch.linalg.eigh(back.T @ A @ back)
    say = axes.T @ (ways @ found[..., None]).flatten()
    variance, share = _variances(say.numpy(), a.numpy())
    assert variance**0.5 == pytest.approx(s, rel=0.2) and share == pytest.approx(k, rel=0.4)


def test_steepest_pixels():
    squares = torch.rand(9, 7, generator=torch.Generator().manual_seed(1)) ** 4
    squares[0] = 0
    told = steepest(squares)
    assert squares[told].sum() >= 0.99 * squares.sum() and squares[told].min() > squares[~told].max()
    fewer = squares[told].sort().values[1:].sum()
    assert fewer < 0.99 * squares.sum()
    assert not steepest(torch.zeros(3, 3)).any()


def test_weighted_median():
    values, weights = torch.tensor([5.0, 1.0, 3.0]), torch.tensor([1.0, 1.0, 4.0])
    assert weighted_median(values, weights) == 3 and weighted_median(values, torch.tensor([9.0, 1, 1])) == 5
    assert weighted_median(torch.zeros(0), torch.zeros(0)) == 0
