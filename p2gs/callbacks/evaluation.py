"""``evaluation``: joint errors while the articulation phase learns, where the scene has ground truth. Logged only:
nothing flows back.

The only callback that opens ground truth.
"""

from __future__ import annotations

from typing import Optional

from p2gs.callbacks.base import Callback, due, register_callback
from p2gs.types import Joint, Similarity, UserError


@register_callback("evaluation")
class Evaluation(Callback):
    """every: steps between two scores.  prismatic_below: a free motion that turns by fewer degrees counts as a
    slide."""

    changes_result = False
    every: int = 250
    prismatic_below: float = 5.0

    def __post_init__(self):
        self._truth: Optional[tuple[Joint, ...]] = None
        self._similarity = Similarity()

    def prepare(self, cfg, scene) -> None:
        from p2gs.data.ground_truth import load_ground_truth
        from p2gs.data.layouts import LAYOUTS

        root = getattr(cfg.data, "root", None)
        if root is None:
            return
        name = cfg.data_options["format"]
        try:
            truth = load_ground_truth(root, name if name in LAYOUTS else None, cfg.data_options.get("source"))
        except UserError:  # unreadable ground truth is `p2gs test`'s and `data check`'s to tell; training needs none
            return
        self._truth = truth.joints if truth is not None else None
        self._similarity = scene.similarity

    def on_step(self, trainer, phase) -> None:
        if self._truth is None or trainer.logger is None or not due(phase.step, self.every, phase.total_steps):
            return
        joints = current_joints(phase, self._similarity, self.prismatic_below)
        if joints is not None:
            values = joint_scores(joints, self._truth)
            for logger in trainer.loggers:
                logger.log_metrics({f"{phase.phase_name}/error/{k}": v for k, v in values.items()}, step=phase.step)


def current_joints(phase, similarity: Similarity, prismatic_below: float) -> Optional[list[Joint]]:
    """The joints a phase has learned so far, in input units; None for a phase that learns none."""
    from p2gs.gaussians.handover import Articulation
    from p2gs.models.joint_of import make_joint, name_types

    learned = phase.hand_over() if hasattr(phase, "screws") else None
    if not isinstance(learned, Articulation):
        return None
    labels, joints = learned.part_ids, []
    for k, kind in enumerate(name_types(learned.types, learned.transforms, prismatic_below)):
        rows = labels == k + 1
        points = learned.gaussians.means[rows if bool(rows.any()) else slice(None)].double()
        joints.append(
            make_joint(
                kind, similarity.transform_to_input(learned.transforms[k].double()), similarity.to_input(points).mean(0)
            )
        )
    return joints


def joint_scores(joints: list[Joint], truth) -> dict[str, float]:
    """Errors by joint (``1/axis_angle`` ...) and the number that failed, as a logger takes them."""
    from p2gs.metrics.modules import JointError

    metric = JointError()
    metric.update(joints, list(truth))
    values = {"failures": float(metric.compute()["failures"])}
    for score in metric.report.joints:
        if score.errors is not None:
            errors = {
                "axis_angle": score.errors.axis_angle,
                "axis_position": score.errors.axis_position,
                "motion": score.errors.motion,
            }
            values.update({f"{score.gt + 1}/{k}": v for k, v in errors.items() if v is not None})
    return values
