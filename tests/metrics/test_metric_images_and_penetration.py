import doctest

import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from p2gs.metrics import image, modules, penetration
from p2gs.ops import se3, so3
from p2gs.types import ArticulatedObject, GaussianTensors, Joint, Part


@pytest.mark.parametrize("module", [image, modules, penetration])
def test_docstrings_run(module):
    result = doctest.testmod(module)
    assert result.failed == 0
    assert result.attempted >= 2


def test_image_scores_agree_with_skimage():
    g = torch.Generator().manual_seed(0)
    a = torch.rand(40, 50, 3, generator=g)
    b = (a + 0.1 * torch.randn(40, 50, 3, generator=g)).clamp(0, 1)
    assert image.psnr(a, b) == pytest.approx(peak_signal_noise_ratio(a.numpy(), b.numpy(), data_range=1.0), abs=1e-3)
    # both extend the border, each in its own way: a uniform border makes the way irrelevant
    framed = [torch.nn.functional.pad(x, (0, 0, 12, 12, 12, 12)) for x in (a, b)]
    _, similarity = structural_similarity(
        *(x.numpy() for x in framed),
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        full=True,
    )
    assert image.ssim(*framed) == pytest.approx(similarity.mean(), abs=1e-4)
    report = image.evaluate_images([a, a], [b, (a + 0.01).clamp(0, 1)])
    assert report.psnr == pytest.approx(sum(v["psnr"] for v in report.per_view) / 2)
    with pytest.raises(ValueError, match="do not pair"):
        image.evaluate_images([a], [])
    assert image.psnr(a + 5, torch.ones_like(a)) == float("inf")  # clamped


def gaussians(means, scale=0.05, opacity=6.0):
    n = len(means)
    quats = torch.randn(n, 4, generator=torch.Generator().manual_seed(1))
    return GaussianTensors(
        means, quats, torch.full((n, 3), scale).log(), torch.full((n,), opacity), torch.zeros(n, 1, 3)
    )


def occupancy_naive(static, points):
    R = so3.quat_to_matrix(static.quats.double())
    out = []
    for x in points.double():
        clear = 1.0
        for i in range(len(static)):
            local = R[i].T @ (x - static.means[i].double()) / static.log_scales[i].double().exp()
            if local @ local < 9:
                clear *= (
                    1 - torch.sigmoid(static.opacity_logits[i].double()).item() * torch.exp(-0.5 * local @ local).item()
                )
        out.append(1 - clear)
    return torch.tensor(out, dtype=torch.float64)


def test_occupancy_is_its_definition():
    g = torch.Generator().manual_seed(2)
    static = gaussians(torch.rand(30, 3, generator=g))
    static.log_scales += 0.8 * torch.randn(30, 3, generator=g)
    static.opacity_logits = 3 * torch.randn(30, generator=g)
    points = torch.rand(50, 3, generator=g)
    torch.testing.assert_close(penetration.occupancy(static, points), occupancy_naive(static, points))
    assert (penetration.occupancy(static, points + 50) == 0).all()
    assert penetration.penetration(static, points[:0]) == 0
    assert penetration.penetration(static[:0], points) == 0


def test_a_drawer_pushed_through_the_wall_penetrates_and_an_open_one_does_not():
    y, z = torch.meshgrid(torch.linspace(-1, 1, 41), torch.linspace(-1, 1, 41), indexing="ij")
    wall = torch.stack([torch.zeros_like(y), y, z], -1).reshape(-1, 3)
    drawer = wall[::7] * 0.5 + torch.tensor([0.5, 0, 0])
    both = gaussians(torch.cat([wall, drawer]))
    ids = torch.cat([torch.zeros(len(wall)), torch.full((len(drawer),), 3)]).long()

    def twin(slide):
        T = se3.from_screw(torch.tensor([1.0, 0, 0]), torch.zeros(3), 0.0, slide)
        joint = Joint("prismatic", torch.tensor([1.0, 0, 0]), torch.zeros(3), slide, (0.0, slide), T)
        return ArticulatedObject(both, ids, [Part(0), Part(3, joint)], canonical_time=0.0)

    assert penetration.evaluate_penetration(twin(1.0)) == {"mean": 0.0, "max": 0.0}
    through = penetration.evaluate_penetration(twin(-1.0), times=(0.0, 0.5, 1.0))
    assert through["max"] == pytest.approx(1.0, abs=0.05)
    assert through["mean"] == pytest.approx(through["max"] / 3)
    metric = modules.Penetration()
    metric.update(twin(1.0))
    metric.update(twin(-1.0))
    assert metric.compute()["mean"] == pytest.approx(penetration.evaluate_penetration(twin(-1.0))["mean"] / 2)
    metric.reset()
    assert metric.mean_count == 0


def test_metrics_leave_out_what_is_missing():
    from types import SimpleNamespace

    door = SimpleNamespace(type="revolute", axis=[0, 0, 1], origin=[0, 0, 0], motion=60.0)
    drawer = SimpleNamespace(type="prismatic", axis=[0, 0, 1], origin=[0, 0, 0], motion=0.3)
    metric = modules.JointError()
    metric.update([door], [door])
    metric.update([drawer], [drawer])
    metric.update([], [drawer])
    result = metric.compute()
    assert result["failures"] == 1
    assert result["joints"] == 3
    assert result["pos_revolute"] == pytest.approx(0, abs=1e-9)
    assert metric.pos_revolute_count == 1


def test_view_scores_and_their_metric():
    """A render that is the photograph but for one known error in each quantity."""
    from p2gs.metrics.views import evaluate_view
    from p2gs.types import Camera, RenderOutput, View

    size, g = 40, torch.Generator().manual_seed(3)
    colour = (torch.rand(size, size, 3, generator=g) * 255).byte()
    alpha = torch.zeros(size, size, dtype=torch.uint8)
    alpha[8:32, 8:32] = 255
    depth = torch.where(alpha > 0, 2.0, 0.0)
    view = View("v", 0, "test", Camera(torch.eye(4), torch.eye(3), size, size), colour, alpha, depth)
    mask = (alpha > 0).float()
    photo = colour.float() / 255 * mask[..., None]

    def render(shift=0.0, deeper=0.0):
        return RenderOutput(
            (photo + shift * mask[..., None]),
            mask,
            (depth + deeper) * mask,
            None,
            0.0,
            None,
            None,
            torch.zeros(1),
            None,
        )

    exact = evaluate_view(render(), view, diagonal=3.0)
    assert (
        exact["psnr_white"] == exact["psnr_black"] == float("inf")
        and exact["alpha_error"] == 0
        and exact["depth_bad"] == 0
    )
    assert exact["ssim_white"] == pytest.approx(1, abs=1e-6)
    off = evaluate_view(render(deeper=0.05), view, diagonal=3.0)
    assert off["depth_median"] == pytest.approx(0.05, abs=1e-5) and off["depth_bad"] == 1
    assert evaluate_view(render(deeper=0.02), view, diagonal=3.0)["depth_bad"] == 0
    darker = evaluate_view(render(shift=-0.01), view, diagonal=3.0)
    covered = float(mask.mean())
    wrong = photo - (photo - 0.01).clamp(0) * mask[..., None]
    expected = -10 * torch.log10(wrong.square().mean()).item()
    assert darker["psnr_black"] == pytest.approx(expected, abs=1e-3)
    assert darker["psnr_masked"] == pytest.approx(expected + 10 * torch.log10(torch.tensor(covered)).item(), abs=1e-3)
    metric = modules.ViewQuality()
    for deeper in (0.01, 0.05):
        metric.update(render(shift=-0.01, deeper=deeper), view, 3.0)
    without_depth = View("w", 0, "test", view.camera, colour, alpha)
    metric.update(render(shift=-0.01), without_depth, 3.0)
    means = metric.means()
    assert means["depth_median"] == pytest.approx(0.03, abs=1e-5) and means["psnr_black"] == pytest.approx(
        darker["psnr_black"]
    )
    assert "depth_median" not in metric.report and "lpips" not in means and metric.psnr_white_count == 3
    metric.reset()
    assert metric.report is None and metric.psnr_white_count == 0
