"""LPIPS with random backbone weights in a file; the column is absent where torchvision or the weights are."""

import importlib.util
import json

import pytest
import torch

from p2gs.metrics import lpips as module
from p2gs.metrics.lpips import VARIABLE, WEIGHTS, lpips, weights_file, why_absent
from p2gs.types import UserError

# AlexNet's convolutions
SHAPES = {"0": (64, 3, 11), "3": (192, 64, 5), "6": (384, 192, 3), "8": (256, 384, 3), "10": (256, 256, 3)}


@pytest.fixture
def weights(tmp_path):
    """A file of random weights in torchvision's names and shapes."""
    state = {}
    for layer, (out, of, side) in SHAPES.items():
        state[f"features.{layer}.weight"] = 0.05 * torch.randn(out, of, side, side)
        state[f"features.{layer}.bias"] = torch.zeros(out)
    state["classifier.1.weight"] = torch.zeros(2, 2)
    path = tmp_path / "random_alexnet.pth"
    torch.save(state, path)
    return path


@pytest.fixture(autouse=True)
def no_cache(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    monkeypatch.delenv(VARIABLE, raising=False)


@pytest.fixture
def torchvision(monkeypatch):
    """What torchmetrics takes from torchvision: the layers of its AlexNet, where torchvision itself is not installed
    (extra lpips)."""
    if importlib.util.find_spec("torchvision") is not None:
        return
    from torch import nn
    from torchmetrics.functional.image import lpips as theirs

    def features(net, pretrained=False):
        assert (net, pretrained) == ("alexnet", False)  # nothing is downloaded
        relu = lambda: nn.ReLU(inplace=True)  # noqa: E731
        return nn.Sequential(
            nn.Conv2d(3, 64, 11, 4, 2),
            relu(),
            nn.MaxPool2d(3, 2),
            nn.Conv2d(64, 192, 5, padding=2),
            relu(),
            nn.MaxPool2d(3, 2),
            nn.Conv2d(192, 384, 3, padding=1),
            relu(),
            nn.Conv2d(384, 256, 3, padding=1),
            relu(),
            nn.Conv2d(256, 256, 3, padding=1),
            relu(),
        )

    monkeypatch.setattr(theirs, "_get_tv_model_features", features)
    monkeypatch.setattr(module.importlib.util, "find_spec", lambda name: object())


def test_weights_come_from_a_path_the_environment_or_the_cache(weights, tmp_path, monkeypatch):
    assert weights_file() is None and weights_file(weights) == weights
    monkeypatch.setenv(VARIABLE, str(weights))
    assert weights_file() == weights
    monkeypatch.delenv(VARIABLE)
    (tmp_path / "hub" / "checkpoints").mkdir(parents=True)
    (tmp_path / "hub" / "checkpoints" / WEIGHTS).write_bytes(weights.read_bytes())
    assert weights_file() == tmp_path / "hub" / "checkpoints" / WEIGHTS
    with pytest.raises(UserError, match="no such file"):
        weights_file(tmp_path / "elsewhere.pth")


def test_without_torchvision_or_weights_there_is_no_number_and_one_sentence(weights, monkeypatch):
    picture = torch.rand(64, 64, 3)
    assert lpips(picture, picture) is None and "LPIPS needs" in why_absent()
    monkeypatch.setattr(module.importlib.util, "find_spec", lambda name: None)
    assert lpips(picture, picture, weights) is None and "torchvision" in why_absent(weights)


def test_a_table_has_no_column_without_it():
    from p2gs.bench.results import Run, read_metrics

    run = Run("a", "a", "full", 0, "done")
    read_metrics(run, json.loads('{"views": {"mean": {"psnr_white": 30.0, "ssim_white": 0.9}}}'))
    assert run.values["lpips"] is None  # summary() leaves out what no run has
    read_metrics(run, {"views": {"mean": {"psnr_white": 30.0, "ssim_white": 0.9, "lpips": 0.05}}})
    assert run.values["lpips"] == 0.05


def test_lpips_is_zero_for_equal_pictures_and_grows_with_noise(weights, torchvision):
    generator = torch.Generator().manual_seed(0)
    picture = torch.rand(64, 48, 3, generator=generator)
    noise = torch.randn(64, 48, 3, generator=generator)
    values = [lpips(picture, picture + s * noise, weights) for s in (0.0, 0.02, 0.2)]
    assert values[0] == pytest.approx(0.0, abs=1e-6) and values[0] < values[1] < values[2]
    assert values[2] == pytest.approx(lpips(picture, picture + 0.2 * noise, weights))
    assert lpips(torch.rand(16, 16, 3), torch.rand(16, 16, 3), weights) is None


def test_a_file_of_something_else_is_told(tmp_path, torchvision):
    path = tmp_path / "other.pth"
    torch.save({"a": torch.zeros(2)}, path)
    with pytest.raises(UserError, match="holds no weights of torchvision's AlexNet"):
        lpips(torch.rand(64, 64, 3), torch.rand(64, 64, 3), path)
