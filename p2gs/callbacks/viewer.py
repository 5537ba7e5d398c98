"""``viewer``: the Gaussians in the browser while they are trained (viser, optional). Off unless the config names it."""

from __future__ import annotations

from typing import ClassVar, Optional

import torch

from p2gs.callbacks.base import Callback, due, register_callback
from p2gs.types import ArticulatedObject, Part, Similarity


@register_callback("viewer")
class Viewer(Callback):
    """every: steps between refreshes.  host, port: where the page is served; all phases of a fit share it.

    Single states show as one piece; the fused twin by part; once joints are learned each has a slider.
    """

    changes_result = False
    alone = True  # one server, one port
    every: int = 100
    host: str = "127.0.0.1"
    port: int = 8080

    _stages: ClassVar[dict] = {}  # (host, port) -> Stage; phases get fresh callbacks, the page stays

    def __post_init__(self):
        self._similarity = Similarity()

    def prepare(self, cfg, scene) -> None:
        self._similarity = scene.similarity
        if (self.host, self.port) not in self._stages:
            from p2gs.export.pages.viewer import Stage
            from p2gs.gaussians.views import scene_cameras

            stage = self._stages[self.host, self.port] = Stage(f"p2gs {scene.name}", self.host, self.port)
            stage.add_cameras(scene_cameras(scene))
            print(f"viewer: http://{self.host}:{stage.server.get_port()}", flush=True)

    def on_step(self, trainer, phase) -> None:
        stage = self._stages.get((self.host, self.port))
        if stage is not None and due(phase.step, self.every, phase.total_steps):
            obj = as_object(phase, self._similarity)
            if obj is not None:
                stage.show(obj)


@torch.no_grad()
def as_object(phase, similarity: Similarity) -> Optional[ArticulatedObject]:
    """What a phase has learned so far, in input coordinates; None for a phase that hands over no Gaussians."""
    from p2gs.callbacks.evaluation import current_joints
    from p2gs.gaussians.frame import gaussians_to_input
    from p2gs.gaussians.handover import Articulation, CanonicalGaussians, StateGaussians

    made = phase.hand_over()
    if not isinstance(made, (Articulation, CanonicalGaussians, StateGaussians)):
        return None
    g = gaussians_to_input(made.gaussians.detach().to("cpu"), similarity)
    if isinstance(made, Articulation):
        labels, joints, time = made.part_ids.cpu(), current_joints(phase, similarity, 5.0) or [], made.canonical_time
        parts = [Part(0), *(Part(k + 1, joint) for k, joint in enumerate(joints))]
    else:  # no joints yet: at canonical time, or as the state stands
        time = 0.0
        labels = made.labels.cpu() if isinstance(made, CanonicalGaussians) else torch.zeros(len(g), dtype=torch.int64)
        parts = [Part(int(k)) for k in range(int(labels.max()) + 1 if len(labels) else 1)]
    return ArticulatedObject(g, labels, parts, float(time))
