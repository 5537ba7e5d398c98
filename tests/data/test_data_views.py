"""Training views: order is a pure function of (seed, step), pixels and cameras are those of the photograph."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lightning.pytorch import LightningModule, Trainer

from p2gs.data.base import TwoStateData, Visit
from p2gs.data.box import farthest_cameras, mask_bounds
from p2gs.data.images import downscale_rgba, resize_depth, resize_nearest
from p2gs.data.views import TrainingViews, crop_window, view_index
from p2gs.types import Camera, View


@given(seed=st.integers(-(2**40), 2**40), n=st.integers(1, 40), epoch=st.integers(0, 10**6))
@settings(max_examples=60, deadline=None)
def test_each_view_once_per_epoch_and_nothing_but_seed_and_step_counts(seed, n, epoch):
    steps = range(epoch * n, (epoch + 1) * n)
    forwards = [view_index(seed, s, n) for s in steps]
    backwards = [view_index(seed, s, n) for s in reversed(steps)]
    assert sorted(forwards) == list(range(n)) and forwards == backwards[::-1]


def test_epochs_and_seeds_differ():
    order = lambda seed, epoch: [view_index(seed, epoch * 30 + i, 30) for i in range(30)]  # noqa: E731
    assert order(0, 0) != order(0, 1) and order(0, 0) != order(1, 0)


class Recorder(LightningModule):
    """Notes the batches; fails once at a given step."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.seen, self.views, self.seed = [], {0: range(7), 1: range(5)}, 4

    @property
    def step(self):
        return self.global_step

    def training_step(self, batch, _):
        self.seen.append(batch)
        return self.weight.sum()

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


class Nothing(TwoStateData):
    """A data module without a scene."""

    def __init__(self):
        super().__init__("")

    def setup(self, stage=None):
        pass


def quiet_trainer(steps, folder):
    options = {
        "logger": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
        "enable_checkpointing": False,
    }
    return Trainer(max_steps=steps, max_epochs=-1, accelerator="cpu", default_root_dir=folder, **options)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("stop", [3, 7, 10])
def test_resumed_trainer_sees_what_an_unbroken_one_would(tmp_path, stop):
    """Seven views of one state, five of the other."""
    whole, data = Recorder(), Nothing()
    quiet_trainer(17, tmp_path).fit(whole, datamodule=data)
    first = Recorder()
    trainer = quiet_trainer(stop, tmp_path)
    trainer.fit(first, datamodule=data)
    trainer.save_checkpoint(tmp_path / "stop.ckpt")
    second = Recorder()
    quiet_trainer(17, tmp_path).fit(second, datamodule=data, ckpt_path=tmp_path / "stop.ckpt", weights_only=True)
    assert first.seen + second.seen == whole.seen
    assert whole.seen == [Visit(s, s % 2, view_index(4 + 7919 * (s % 2), s // 2, (7, 5)[s % 2])) for s in range(17)]


def test_a_loader_covers_the_views_of_its_states():
    both = {0: range(8), 1: range(8)}
    loader = Nothing().visits(both, 3)
    seen = [loader[step] for step in range(16)]
    assert sorted(visit[1:] for visit in seen) == [(state, view) for state in (0, 1) for view in range(8)]
    assert list(zip(range(3), Nothing().visits(both, 3, first=5), strict=False)) == [
        (i, loader[5 + i]) for i in range(3)
    ]
    assert [v.view for v, _ in zip(Nothing().visits({1: range(8)}, 3), range(8), strict=False)] == [
        v.view for v in seen if v.state == 1
    ]
    assert Nothing().visits({}, 3)[9] == Visit(9)  # of a phase that looks at none


def random_view(rng, height, width, depth=True):
    alpha = np.zeros((height, width), np.uint8)
    y, x = height // 4, width // 5
    alpha[y : 3 * y, x : 3 * x] = rng.integers(1, 256, (2 * y, 2 * x))
    z = np.where(alpha > 127, rng.uniform(2, 4, alpha.shape), 0).astype(np.float32)
    camera = Camera(
        torch.eye(4), torch.tensor([[50.0, 0, width / 2 + 1], [0, 52.0, height / 2 - 2], [0, 0, 1]]), width, height
    )
    image = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    return View(
        "v",
        0,
        "train",
        camera,
        torch.from_numpy(image),
        torch.from_numpy(alpha),
        torch.from_numpy(z) if depth else None,
    )


def area_slow(view, height, width):
    """Premultiplied colour and alpha (0..1) averaged over each new pixel's area, overlaps weighted, one pixel at a
    time."""
    a = view.alpha.numpy().astype(float) / 255
    stack = np.dstack([view.image.numpy() / 255 * a[..., None], a])
    out = np.zeros((height, width, 4))
    sy, sx = a.shape[0] / height, a.shape[1] / width
    for i in range(height):
        for j in range(width):
            total = 0.0
            for y in range(int(i * sy), min(int(np.ceil((i + 1) * sy - 1e-9)), a.shape[0])):
                for x in range(int(j * sx), min(int(np.ceil((j + 1) * sx - 1e-9)), a.shape[1])):
                    w = (min(y + 1, (i + 1) * sy) - max(y, i * sy)) * (min(x + 1, (j + 1) * sx) - max(x, j * sx))
                    out[i, j] += w * stack[y, x]
                    total += w
            out[i, j] /= total
    return out


@pytest.mark.parametrize("size", [48, 24, 20, 17])
def test_pyramid_equals_its_slow_twin(size):
    view = random_view(np.random.default_rng(1), 36, 48)
    background = torch.tensor([0.3, 0.9, 0.1])
    target = TrainingViews([view], levels=[size], crop=False).get(0, 0, background)
    height, width = target.alpha.shape
    assert (width, height) == (size, round(36 * size / 48)) == (target.camera.width, target.camera.height)
    slow = area_slow(view, height, width)
    np.testing.assert_allclose(target.alpha.numpy(), slow[..., 3], atol=0.51 / 255)
    expected = slow[..., :3] + (1 - slow[..., 3:]) * background.numpy()
    np.testing.assert_allclose(target.image.numpy(), expected, atol=1.02 / 255)
    torch.testing.assert_close(target.camera.K, view.camera.scaled(width, height).K)


def test_straight_downscale_equals_its_slow_twin():
    view = random_view(np.random.default_rng(2), 30, 40)
    colour, alpha = downscale_rgba(view.image.numpy(), view.alpha.numpy(), 16, 12)
    slow = area_slow(view, 12, 16)
    np.testing.assert_allclose(alpha, 255 * slow[..., 3], atol=0.51)
    seen = slow[..., 3] > 0.05
    np.testing.assert_allclose(colour[seen], (255 * slow[..., :3] / np.maximum(slow[..., 3:], 1e-9))[seen], atol=0.52)


def test_nearest_takes_the_pixel_under_the_centre():
    image = np.arange(6 * 9).reshape(6, 9)
    assert np.array_equal(resize_nearest(image, 3, 2), image[1::3, 1::3])
    assert np.array_equal(resize_nearest(image, 18, 12)[::2, 1::2], image)


@pytest.mark.parametrize("size", [(40, 30), (20, 15), (10, 7), (13, 11), (80, 60)])
def test_depth_of_a_plane_stays_where_the_plane_is(size):
    def plane(width, height):  # inverse depth is linear in place
        y, x = np.mgrid[:height, :width] + 0.5
        return 1 / (0.3 + 0.2 * x / width - 0.1 * y / height)

    depth = resize_depth(plane(40, 30).astype(np.float32), *size)
    # beyond the outermost pixels' centres nothing is known
    inside = (slice(1, -1), slice(1, -1)) if size[0] > 40 else ()
    np.testing.assert_allclose(depth[inside], plane(*size)[inside], rtol=3e-4)


def test_depth_beside_the_unknown_is_the_nearest():
    depth = np.full((6, 8), 2.0, np.float32)
    depth[:, :3] = 0
    depth[:, 6:] = 4
    half = resize_depth(depth, 4, 3)
    assert np.array_equal(half, resize_nearest(depth, 4, 3)) and sorted(set(half.ravel())) == [0, 2, 4]
    depth[:, 5:] = 4  # two surfaces in one new pixel: neither is nearer to its centre
    np.testing.assert_allclose(resize_depth(depth, 4, 3)[:, 2], 1 / ((1 / 2 + 1 / 4) / 2), rtol=1e-6)


def test_crop_holds_the_mask_and_its_camera_sees_the_same():
    view = random_view(np.random.default_rng(3), 120, 160)
    views = TrainingViews([view], levels=[160, 80], align=16)
    background = torch.tensor([1.0, 0.0, 0.5])
    for level, scale in ((0, 1.0), (1, 0.5)):
        target = views.get(0, level, background)
        assert (
            target.image.shape[:2]
            == target.alpha.shape
            == target.depth.shape
            == (target.camera.height, target.camera.width)
        )
        assert target.camera.width % 16 == 0 and target.camera.height % 16 == 0
        assert target.camera.width < 160 * scale and views.camera(0, level) is target.camera
        x, y = (int(round(float(view.camera.K[i, 2] * scale - target.camera.K[i, 2]))) for i in (0, 1))
        whole = TrainingViews([view], levels=[160, 80], crop=False).get(0, level, background)
        window = (slice(y, y + target.camera.height), slice(x, x + target.camera.width))
        assert torch.equal(target.image, whole.image[window]) and torch.equal(target.depth, whole.depth[window])
        assert float(whole.alpha.sum()) == pytest.approx(float(target.alpha.sum()), rel=1e-6)
        border = torch.cat([target.alpha[0], target.alpha[-1], target.alpha[:, 0], target.alpha[:, -1]])
        assert not border.any(), "the margin keeps the mask off the border"


@given(
    bounds=st.tuples(st.integers(0, 90), st.integers(0, 60), st.integers(1, 60), st.integers(1, 40)),
    margin=st.integers(0, 12),
    align=st.sampled_from([1, 8, 16, 32]),
)
@settings(max_examples=100, deadline=None)
def test_crop_window_stays_in_the_image_and_holds_the_bounds(bounds, margin, align):
    width, height = 100, 70
    x0, y0 = bounds[:2]
    x1, y1 = min(x0 + bounds[2], width), min(y0 + bounds[3], height)
    x, y, w, h = crop_window((x0, y0, x1, y1), width, height, margin, align)
    assert 0 <= x <= x0 and x1 <= x + w <= width and 0 <= y <= y0 and y1 <= y + h <= height
    assert (w % align == 0 or w == width) and (h % align == 0 or h == height)


def test_get_is_deterministic_and_keys_tell_crops_apart():
    rng = np.random.default_rng(4)
    view = random_view(rng, 50, 50, depth=False)
    other = View("w", 1, "train", view.camera, view.image, view.alpha)
    views = TrainingViews([view, other], levels=[25, 50, 100])
    background = torch.rand(3)
    a, b = views.get(0, 1, background), views.get(0, 1, background)
    assert torch.equal(a.image, b.image) and a.key == b.key and a.depth is None
    a.image.zero_()
    assert torch.equal(views.get(0, 1, background).image, b.image), "a caller may write into what it got"
    keys = {views.get(i, level, background).key for i in (0, 1) for level in (0, 1)}
    assert len(keys) == 4
    assert torch.equal(views.get(0, 2, background).image, b.image), (
        "a level above the photograph's size holds it at its own size"
    )


@given(n=st.integers(0, 40), count=st.integers(1, 50))
@settings(max_examples=60, deadline=None)
def test_spread_goes_evenly_from_the_first_view_to_the_last(n, count):
    views = TrainingViews([])
    views._stored = [None] * n
    picked = views.spread(count)
    assert len(picked) == min(n, count) and picked == sorted(set(picked))
    if n:
        assert picked[0] == 0 and (count == 1 or picked[-1] == n - 1)
    assert len(picked) < 2 or np.ptp(np.diff(picked)) <= 1


def test_mask_bounds_and_farthest_cameras():
    alpha = torch.zeros(10, 12, dtype=torch.uint8)
    assert mask_bounds(alpha) == (0, 0, 12, 10)
    alpha[3:5, 7:9] = 1
    assert mask_bounds(alpha) == (7, 3, 9, 5)
    line = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.5, 0, 0], [1.0, 0, 0]])
    assert (
        farthest_cameras(line, 2) == [0, 3]
        and farthest_cameras(line, 3) == [0, 2, 3]
        and farthest_cameras(line, 9) == [0, 1, 2, 3]
    )
