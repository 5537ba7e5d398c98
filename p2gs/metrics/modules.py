"""The metrics as ``torchmetrics.Metric``: collect over objects or batches, reset, log. Thin; the work is in the
functions.

``p2gs test``, the callback ``evaluation`` and the benches compute through these. States are sums and counts, so results
of several processes add up; ``report`` is what the last update found, joint by joint or view by view.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric

from p2gs.metrics.chamfer import evaluate_chamfer
from p2gs.metrics.image import evaluate_images
from p2gs.metrics.joints import evaluate_joints
from p2gs.metrics.penetration import evaluate_penetration
from p2gs.metrics.views import DEPTH_NAMES, NAMES, evaluate_view


class _Means(Metric):
    """Mean of named numbers over updates; None is left out of its mean, which is NaN where nothing came."""

    full_state_update = False
    higher_is_better = False
    names: tuple[str, ...] = ()
    counted: tuple[str, ...] = ()

    def __init__(self, **options):
        super().__init__(**options)
        self.report: Any = None
        for name in self.names:
            self.add_state(f"{name}_sum", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
            self.add_state(f"{name}_count", torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")
        for name in self.counted:
            self.add_state(name, torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")

    def _note(self, values: dict) -> None:
        for name in self.names:
            if values.get(name) is not None:
                setattr(self, f"{name}_sum", getattr(self, f"{name}_sum") + float(values[name]))
                setattr(self, f"{name}_count", getattr(self, f"{name}_count") + 1)
        for name in self.counted:
            setattr(self, name, getattr(self, name) + int(values[name]))

    def compute(self) -> dict[str, Tensor]:
        means = {n: getattr(self, f"{n}_sum") / getattr(self, f"{n}_count") for n in self.names}
        return means | {n: getattr(self, n) for n in self.counted}

    def means(self) -> dict[str, float]:
        """``compute()`` as plain numbers, for JSON, without the names for which nothing came."""
        return {name: value.item() for name, value in self.compute().items() if not math.isnan(value.item())}

    def reset(self) -> None:
        super().reset()
        self.report = None


class JointError(_Means):
    """Means of ``evaluate_joints`` over objects: axis_angle [degrees], pos_artgs and pos_revolute [x10], motion,
    failures (count).

    >>> from types import SimpleNamespace as J
    >>> door = J(type="revolute", axis=[0, 0, 1], origin=[0, 0, 0], motion=60.0)
    >>> metric = JointError()
    >>> metric.update([J(type="revolute", axis=[0, 0, 1], origin=[0.02, 0, 0], motion=61.0)], [door])
    >>> round(metric.compute()["pos_revolute"].item(), 6)
    0.2
    """

    names = ("axis_angle", "pos_artgs", "pos_revolute", "motion")
    counted = ("failures", "joints")

    def update(self, pred, gt, assignment=None) -> None:
        """pred, gt: lists of joints of one object, see ``evaluate_joints``."""
        self.report = report = evaluate_joints(pred, gt, assignment)
        values = {
            "axis_angle": report.axis_angle_mean,
            "pos_artgs": report.pos_mean_artgs,
            "pos_revolute": report.pos_mean_revolute,
        }
        self._note(values | {"motion": report.motion_mean, "failures": report.failures, "joints": len(gt)})


class PartChamfer(_Means):
    """Means of ``evaluate_chamfer`` over objects: static, movable, whole (x1000), failures (count).

    >>> import numpy as np
    >>> from p2gs.metrics.chamfer import PartMeshes
    >>> from p2gs.ops.mesh import Mesh
    >>> tile = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    >>> metric = PartChamfer()
    >>> metric.update({"start": PartMeshes(tile, [])}, {"start": PartMeshes(tile, [])}, {})
    >>> metric.compute()["static"].item() < 0.04
    True
    """

    names = ("static", "movable", "whole")
    counted = ("failures",)

    def update(self, pred, gt, assignment) -> None:
        """State name -> PartMeshes of one object, and gt part -> predicted part, see ``evaluate_chamfer``."""
        self.report = report = evaluate_chamfer(pred, gt, assignment)
        self._note(
            {"static": report.static, "movable": report.movable, "whole": report.whole, "failures": report.failures}
        )


class ImageQuality(_Means):
    """Means over views: psnr [dB], ssim.

    >>> metric = ImageQuality()
    >>> metric.update([torch.zeros(16, 16, 3)], [torch.full((16, 16, 3), 0.1)])
    >>> round(metric.compute()["psnr"].item(), 3)
    20.0
    """

    higher_is_better = True
    names = ("psnr", "ssim")

    def update(self, pred, target) -> None:
        """Lists of images [H, W, 3] in [0, 1], see ``evaluate_images``."""
        self.report = evaluate_images(pred, target)
        for view in self.report.per_view:
            self._note(view)


class ViewQuality(_Means):
    """Means over views of ``evaluate_view``: psnr_*, ssim_*, lpips, alpha_error, depth_*.

    ``metric = ViewQuality(); metric.update(render, view, diagonal); metric.means()["psnr_white"]``
    """

    names = (*NAMES, *DEPTH_NAMES)

    def update(self, render, view, diagonal: float) -> None:
        """render: RenderOutput over black.  view: the photograph.  diagonal: of the object's box."""
        self.report = evaluate_view(render, view, diagonal)
        self._note(self.report)


class Penetration(_Means):
    """Mean over twins of ``evaluate_penetration``: mean and worst fraction of movable Gaussians inside the base.

    ``metric = Penetration(); metric.update(twin); metric.compute()["mean"]``
    """

    names = ("mean", "max")

    def update(self, twin) -> None:
        """twin: p2gs.types.ArticulatedObject."""
        self.report = evaluate_penetration(twin)
        self._note(self.report)
