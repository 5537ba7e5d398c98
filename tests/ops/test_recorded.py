"""Recorded losses are the losses themselves: on a CPU they are called as they are, on a GPU replayed as graphs."""

import pytest
import torch

from p2gs.models.adam import NamedAdam
from p2gs.ops.pixels import depth_spread
from p2gs.ops.planar import hidden_bends
from p2gs.ops.recorded import Recorder, recorded, recording
from p2gs.ops.ssim import l1_ssim

on_a_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


def _pictures(height, width, seed, device="cpu"):
    generator = torch.Generator().manual_seed(seed)
    image, target = torch.rand(2, height, width, 3, generator=generator).to(device)
    alpha, depth, spread = torch.rand(3, height, width, generator=generator).to(device) * 0.5 + 0.5
    return image.requires_grad_(), target, alpha.requires_grad_(), depth.requires_grad_(), spread


def _losses(image, target, alpha, depth, spread, ref):
    return {
        "render": l1_ssim(image, target, 0.2),
        "planar": hidden_bends(target, torch.ones_like(alpha), depth, alpha, (3, 9), 0.1, 0.01),
        "depth_variance": depth_spread(alpha, depth, spread, torch.ones_like(alpha), ref),
    }


def _gradients(pictures, ref):
    out = {}
    for name, value in _losses(*pictures, ref).items():
        leaves = [t for t in pictures if t.requires_grad]
        out[name] = [value.detach(), *torch.autograd.grad(2.5 * value, leaves, allow_unused=True)]
    return out


def test_without_a_gpu_the_function_is_called():
    calls = []

    def square(x, factor):
        calls.append(factor)
        return factor * (x * x).sum()

    recorder, x = Recorder(), torch.tensor([1.0, 2.0], requires_grad=True)
    with recording(recorder):
        for _ in range(2):
            assert recorded(square, x, constants=(3.0,)) == 15.0
    assert calls == [3.0, 3.0] and not recorder.graphs


@on_a_gpu
def test_replayed_losses_are_the_losses():
    recorder = Recorder()
    # sizes come again, in another order and after larger ones, as crops of photographs do; numbers change
    for turn, (height, width) in enumerate([(64, 48), (80, 96), (64, 48), (32, 112), (80, 96)]):
        pictures = _pictures(height, width, turn, "cuda")
        want = _gradients(pictures, 0.3 * turn)
        with recording(recorder):
            got = _gradients(pictures, 0.3 * turn)
        for name in want:
            for a, b in zip(want[name], got[name], strict=True):
                assert (a is None) == (b is None)
                assert a is None or torch.allclose(a, b, rtol=1e-5, atol=1e-9), (name, turn)
    assert len(recorder.graphs) == 9  # of three losses at three sizes


@on_a_gpu
def test_two_calls_before_one_backward_pass():
    (image, target, *_), (other, *_) = _pictures(40, 40, 0, "cuda"), _pictures(40, 40, 1, "cuda")
    want = torch.autograd.grad(l1_ssim(image, target) + l1_ssim(other, target), (image, other))
    with recording(Recorder()):
        got = torch.autograd.grad(l1_ssim(image, target) + l1_ssim(other, target), (image, other))
    for a, b in zip(want, got, strict=True):
        assert torch.allclose(a, b, rtol=1e-5, atol=1e-9)


@on_a_gpu
def test_without_gradient():
    image, target, *_ = _pictures(40, 40, 0, "cuda")
    with torch.no_grad(), recording(Recorder()):
        assert torch.allclose(l1_ssim(image, target), l1_ssim(image.clone(), target))


@on_a_gpu
def test_adam_of_a_gpu_goes_the_way_of_a_cpu():
    start, moves = torch.randn(50, 3), torch.randn(20, 50, 3)
    ways = []
    for device in ("cpu", "cuda"):
        x = start.to(device).clone().requires_grad_()
        optimizer = NamedAdam([{"params": [x], "name": "x"}], lr=0.01)
        for step, gradient in enumerate(moves):
            x.grad = gradient.to(device).clone()
            optimizer.step()
            if step == 9:  # as a run that was interrupted goes on
                state, optimizer = optimizer.state_dict(), NamedAdam([{"params": [x], "name": "x"}], lr=0.01)
                optimizer.load_state_dict(state)
        ways.append(x.detach().cpu())
    assert torch.allclose(*ways, atol=1e-6)
