"""LPIPS of rendered views (Zhang et al. 2018, arXiv:1801.03924), AlexNet backbone, through torchmetrics; needs the
extra ``lpips``.

torchmetrics brings the linear layers; the backbone's ImageNet weights are a file of 240 MB that torchvision would
download. Nothing is downloaded here: they come from a path that the user gives, or from torch's cache
(``torch.hub.get_dir()/checkpoints``), where any earlier use of torchvision's AlexNet has left them.
"""

from __future__ import annotations

import functools
import importlib.util
import os
from pathlib import Path
from typing import Optional

import torch
from torch import Tensor, nn

from p2gs.types import UserError

WEIGHTS = "alexnet-owt-7be5be79.pth"  # torchvision's AlexNet_Weights.IMAGENET1K_V1
VARIABLE = "P2GS_LPIPS_WEIGHTS"  # a path to that file
SMALLEST = 32  # pixels a side: below this AlexNet's third pooling has nothing left to pool


def weights_file(path: Optional[Path | str] = None) -> Optional[Path]:
    """The backbone's weights: ``path``, or the file that P2GS_LPIPS_WEIGHTS names, or torch's cache; None where the
    cache has none.

    Raises UserError where a path was given and no file is there.
    """
    given = path or os.environ.get(VARIABLE)
    if given:
        if not Path(given).is_file():
            raise UserError(f"{given}: no such file; expected the weights of torchvision's AlexNet ({WEIGHTS})")
        return Path(given)
    cached = Path(torch.hub.get_dir()) / "checkpoints" / WEIGHTS
    return cached if cached.is_file() else None


def why_absent(path: Optional[Path | str] = None) -> Optional[str]:
    """Why LPIPS cannot be had, in a sentence; None where it can. Raises UserError as ``weights_file`` does."""
    file = weights_file(path)
    if importlib.util.find_spec("torchvision") is None:
        return "LPIPS needs torchvision (pip install 'p2gs[lpips]')"
    if file is None:
        return f"LPIPS needs AlexNet's weights: {WEIGHTS} in torch's cache, or {VARIABLE}=FILE"
    return None


def wanted() -> bool:
    """Whether the user has done anything towards LPIPS: torchvision is installed, or weights are named."""
    return importlib.util.find_spec("torchvision") is not None or bool(os.environ.get(VARIABLE))


@functools.cache
def network(file: Path) -> nn.Module:
    """torchmetrics' LPIPS network with the backbone of ``file``. Raises UserError where the file holds no AlexNet."""
    from torchmetrics.functional.image.lpips import _NoTrainLpips

    net = _NoTrainLpips(net="alex", pnet_rand=True)
    try:
        stored = torch.load(file, map_location="cpu", weights_only=True)
        layers = {
            name.removeprefix("features."): value for name, value in stored.items() if name.startswith("features.")
        }
        named = {name: layers[name.split(".", 1)[1]] for name in net.net.state_dict()}
        net.net.load_state_dict(named)
    except Exception as err:
        reason = " ".join(str(err).split())
        raise UserError(
            f"{file}: holds no weights of torchvision's AlexNet ({type(err).__name__}: {reason[:120]})"
        ) from err
    return net


@torch.no_grad()
def lpips(pred: Tensor, target: Tensor, path: Optional[Path | str] = None) -> Optional[float]:
    """LPIPS of images [H, W, 3] in [0, 1] (clamped); None where ``why_absent`` says so, or for an image below 32 pixels
    a side.

    path: as in ``weights_file``. Raises UserError for a file that is missing or holds something else.
    """
    if why_absent(path) is not None or min(pred.shape[:2]) < SMALLEST:
        return None
    a, b = (x.detach().cpu().float().clamp(0, 1).permute(2, 0, 1)[None] for x in (pred, target))
    return float(network(weights_file(path))(a, b, normalize=True))
