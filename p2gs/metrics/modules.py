"""The metrics as ``torchmetrics.Metric``: collect over objects or batches, reset, log. Thin; the work is in the functions.

States are sums and counts, so results of several processes add up.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torchmetrics import Metric

from p2gs.metrics.chamfer import ChamferReport, evaluate_chamfer
from p2gs.metrics.image import evaluate_images
from p2gs.metrics.joints import JointReport, evaluate_joints
from p2gs.metrics.penetration import evaluate_penetration


class _Means(Metric):
    """Mean of named numbers over updates; None is left out of its mean, which is NaN where nothing came."""

    full_state_update = False
    higher_is_better = False
    names: tuple[str, ...] = ()
    counted: tuple[str, ...] = ()

    def __init__(self, **options):
        super().__init__(**options)
        for name in self.names:
            self.add_state(f"{name}_sum", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
            self.add_state(f"{name}_count", torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")
        for name in self.counted:
            self.add_state(name, torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")

    def _note(self, values: dict) -> None:
        for name in self.names:
            if values[name] is not None:
                setattr(self, f"{name}_sum", getattr(self, f"{name}_sum") + float(values[name]))
                setattr(self, f"{name}_count", getattr(self, f"{name}_count") + 1)
        for name in self.counted:
            setattr(self, name, getattr(self, name) + int(values[name]))

    def compute(self) -> dict[str, Tensor]:
        means = {n: getattr(self, f"{n}_sum") / getattr(self, f"{n}_count") for n in self.names}
        return means | {n: getattr(self, n) for n in self.counted}


class JointError(_Means):
    """Means of ``evaluate_joints`` over objects: axis_angle [degrees], pos_artgs and pos_revolute [x10], motion, failures (count).

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
        report: JointReport = evaluate_joints(pred, gt, assignment)
        values = {"axis_angle": report.axis_angle_mean, "pos_artgs": report.pos_mean_artgs, "pos_revolute": report.pos_mean_revolute}
        self._note(values | {"motion": report.motion_mean, "failures": report.failures, "joints": len(gt)})


class PartChamfer(_Means):
    """Means of ``evaluate_chamfer`` over objects: static, movable, whole (x1000), failures (count).

    >>> import numpy as np
    >>> from p2gs.metrics.chamfer import PartMeshes, PlainMesh
    >>> tile = PlainMesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    >>> metric = PartChamfer()
    >>> metric.update({"start": PartMeshes(tile, [])}, {"start": PartMeshes(tile, [])}, {})
    >>> metric.compute()["static"].item() < 0.04
    True
    """

    names = ("static", "movable", "whole")
    counted = ("failures",)

    def update(self, pred, gt, assignment) -> None:
        """State name -> PartMeshes of one object, and gt part -> predicted part, see ``evaluate_chamfer``."""
        report: ChamferReport = evaluate_chamfer(pred, gt, assignment)
        self._note({"static": report.static, "movable": report.movable, "whole": report.whole, "failures": report.failures})


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
        for view in evaluate_images(pred, target).per_view:
            self._note(view)


class Penetration(_Means):
    """Mean over twins of ``evaluate_penetration``: mean and worst fraction of movable Gaussians inside the base.

    ``metric = Penetration(); metric.update(twin); metric.compute()["mean"]``
    """

    names = ("mean", "max")

    def update(self, twin) -> None:
        """twin: p2gs.types.ArticulatedObject."""
        self._note(evaluate_penetration(twin))
