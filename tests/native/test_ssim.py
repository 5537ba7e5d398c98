"""The fused loss against its torch twin in double precision, and the twin against torchmetrics."""

import pytest
import torch
import torch.nn.functional as F

from p2gs.native import native
from p2gs.ops.ssim import gaussian_window, l1_ssim, l1_ssim_reference, psnr, ssim, ssim_map

SIZES = [(1, 1), (1, 7), (9, 1), (2, 3), (5, 6), (11, 11), (12, 17), (31, 33), (64, 5), (100, 101), (67, 200)]


def photograph(height, width, seed=0):
    """Smooth blobs with flat regions of 0 and 1, as in pictures of an object before a plain background."""
    g = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 3, max(height // 8, 2), max(width // 8, 2), generator=g) * 1.6 - 0.3
    return F.interpolate(coarse, size=(height, width), mode="bicubic")[0].permute(1, 2, 0).clamp(0, 1).contiguous()


def pair(height, width):
    target = photograph(height, width, 1)
    return (0.7 * target + 0.3 * photograph(height, width, 2)).contiguous(), target


def value_and_grad(function, pred, *args, **kwargs):
    pred = pred.clone().requires_grad_()
    value = function(pred, *args, **kwargs)
    value.backward()
    return value.item(), pred.grad


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("lam", [0.0, 0.2, 1.0])
def test_value_and_gradient(isa, size, lam):
    pred, target = pair(*size)
    value, grad = value_and_grad(l1_ssim, pred, target, lam)
    expected, expected_grad = value_and_grad(l1_ssim_reference, pred.double(), target.double(), lam)
    assert abs(value - expected) < 1e-6
    # flat regions near 1 cost digits in any float32 (mean(x^2) - mean(x)^2): at least as good there as the twin is
    _, single_grad = value_and_grad(l1_ssim_reference, pred, target, lam)
    error, single_error = ((g.double() - expected_grad).norm() / expected_grad.norm() for g in (grad, single_grad))
    assert error <= max(1e-5, single_error)


def test_unequal_noise(isa):
    """Far from each other, nothing smooth: every term of the gradient matters."""
    pred, target = torch.rand(45, 71, 3), torch.rand(45, 71, 3)
    value, grad = value_and_grad(l1_ssim, pred, target, 0.8)
    expected, expected_grad = value_and_grad(l1_ssim_reference, pred.double(), target.double(), 0.8)
    assert value == pytest.approx(expected, rel=1e-6)
    torch.testing.assert_close(grad.double(), expected_grad, rtol=1e-4, atol=1e-5 * expected_grad.abs().max().item())


def test_reference_gradient():
    pred, target = pair(7, 8)
    # away from |x - y| = 0, where L1 has no derivative
    pred = (pred + 0.03).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda p: l1_ssim_reference(p, target.double(), 0.4), (pred,))


def test_ssim_agrees_with_torchmetrics():
    """Their borders are padded by reflection: compared five pixels away from them."""
    from torchmetrics.functional.image import structural_similarity_index_measure

    pred, target = pair(60, 50)
    # torchmetrics' window has 3.5 sigma to each side: sigma 1.5 gives 11 taps
    _, picture = structural_similarity_index_measure(
        pred.permute(2, 0, 1)[None].double(),
        target.permute(2, 0, 1)[None].double(),
        sigma=1.5,
        data_range=1.0,
        return_full_image=True,
    )
    ours = ssim_map(pred.double(), target.double())
    assert picture.shape[-2:] == (60, 50)
    torch.testing.assert_close(ours[5:-5, 5:-5], picture[0].permute(1, 2, 0)[5:-5, 5:-5], rtol=1e-6, atol=1e-8)


def test_same_bits_for_any_thread_count(isa):
    pred, target = pair(173, 91)
    results = []
    for threads in (1, 2, 5):
        torch.set_num_threads(threads)
        results.append(value_and_grad(l1_ssim, pred, target, 0.2))
    for value, grad in results[1:]:
        assert value == results[0][0]
        assert torch.equal(grad, results[0][1])


def test_cache_changes_nothing_and_is_not_fooled():
    pred, target = pair(40, 30)
    plain = value_and_grad(l1_ssim, pred, target)
    cache = {}
    for _ in range(2):
        value, grad = value_and_grad(l1_ssim, pred, target, cache=cache, key="view")
        assert value == plain[0] and torch.equal(grad, plain[1])
    assert list(cache) == [("l1_ssim", "view")] and cache["l1_ssim", "view"] is not None

    target.mul_(0.5)  # the same tensor with other content
    value, grad = value_and_grad(l1_ssim, pred, target, cache=cache, key="view")
    fresh = value_and_grad(l1_ssim, pred, target.clone())
    assert value == fresh[0] and torch.equal(grad, fresh[1])


def test_cache_keeps_nothing_for_targets_composed_anew():
    pred, target = pair(20, 20)
    cache = {}
    for step in range(3):
        anew = target * (1 - 0.1 * step)
        value = l1_ssim(pred, anew, cache=cache, key=0).item()
        assert value == l1_ssim(pred, anew).item()
    assert cache == {("l1_ssim", 0): None}


@pytest.mark.parametrize("cached", [False, True])
def test_box_is_the_loss_of_the_crop(cached):
    pred, target = pair(50, 60)
    box = (7, 11, 33, 22)
    value, grad = value_and_grad(l1_ssim, pred, target, mask_box=box, cache={} if cached else None, key=1)
    crop, crop_grad = value_and_grad(l1_ssim, pred[11:33, 7:40].clone(), target[11:33, 7:40].clone())
    assert value == crop
    assert torch.equal(grad[11:33, 7:40], crop_grad)
    outside = grad.clone()
    outside[11:33, 7:40] = 0
    assert not outside.any()


def test_other_memory_layouts():
    pred, target = pair(33, 21)
    expected = value_and_grad(l1_ssim, pred, target)
    planar = target.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    value, grad = value_and_grad(l1_ssim, pred.transpose(0, 1).contiguous().transpose(0, 1), planar)
    assert value == expected[0] and torch.equal(grad, expected[1])


def test_gradient_is_scaled_by_what_follows():
    pred, target = pair(16, 16)
    _, grad = value_and_grad(l1_ssim, pred, target)
    _, tripled = value_and_grad(lambda p, t: 3 * l1_ssim(p, t), pred, target)
    torch.testing.assert_close(tripled, 3 * grad)


def test_equal_images():
    image = photograph(30, 40)
    value, grad = value_and_grad(l1_ssim, image, image.clone())
    assert abs(value) < 1e-6
    assert grad.abs().max() < 1e-6
    assert ssim(image, image).item() == pytest.approx(1.0)
    assert psnr(image, image).item() == float("inf")
    assert psnr(image, image + 0.1).item() == pytest.approx(20.0, abs=1e-3)


def test_nan_is_not_hidden(isa):
    pred, target = pair(30, 30)
    pred[15, 15, 1] = float("nan")
    value, grad = value_and_grad(l1_ssim, pred, target)
    assert value != value
    assert grad[15, 15, 1].isnan()
    # further away than two windows nothing is touched
    _, clean = value_and_grad(l1_ssim, pair(30, 30)[0], target)
    assert torch.equal(grad[:5, :5], clean[:5, :5])


def test_double_precision_takes_the_reference():
    pred, target = pair(10, 10)
    assert l1_ssim(pred.double(), target.double()).dtype == torch.float64


def test_wrong_shapes():
    image = torch.zeros(5, 6, 3)
    with pytest.raises(ValueError, match="two images"):
        l1_ssim(image, torch.zeros(6, 5, 3))
    with pytest.raises(ValueError, match="two images"):
        l1_ssim(image[..., :2], image[..., :2])
    with pytest.raises(ValueError, match="not inside"):
        l1_ssim(image, image, mask_box=(3, 0, 4, 2))


def test_window():
    assert gaussian_window(torch.float64).sum().item() == pytest.approx(1.0, abs=1e-15)


def test_native_is_there():
    """The tests above would silently compare the reference with itself."""
    assert native is not None


def test_value_without_gradient_at_any_alignment():
    """Scratch memory may start anywhere: sizes that move it about, with and without a gradient, give the same value."""
    for height, width in ((64, 64), (96, 112), (101, 37), (33, 200)):
        generator = torch.Generator().manual_seed(height)
        a, b = torch.rand(2, height, width, 3, generator=generator)
        with torch.no_grad():
            value = l1_ssim(a, b, 0.8)
        assert torch.equal(value, l1_ssim(a.clone().requires_grad_(), b, 0.8).detach())
