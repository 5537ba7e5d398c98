"""What a loss is: a small dataclass with a weight and a span of steps, called with what the phase has at hand.

Write one in a file of your own::

    from p2gs.losses.base import Loss, LossInputs, register_loss

    @register_loss("brightness")
    class Brightness(Loss):
        needs = frozenset()  # looks at the render alone
        target: float = 0.5

        def compute(self, inputs: LossInputs):
            return (inputs.render.colour.mean() - self.target) ** 2

and switch it on from YAML: ``losses: {brightness: {weight: 0.1}}``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Optional

from torch import Tensor

from p2gs.ops import se3
from p2gs.ops.blend import part_motions
from p2gs.registry import Registry
from p2gs.types import Camera, GaussianTensors, RenderOutput, UserError

LOSSES: Registry[type["Loss"]] = Registry("loss")
NEEDS = {
    "depth_sq": "RenderOutput.depth_sq",
    "planes": "RenderOutput.features: ops.planes.plane_features, where photographs have depth maps",
    "parts": "LossInputs.parts",
    "pairs": "PartState.pairs, mu0, mu1: without observed pairs the loss is nothing",
    "rotations": "PartState.target_rotation",
}
KINDS = ("image", "prior", "parts", "motion", "physics", "own")


@dataclass
class Target:
    """What a rendered view is held against, already cropped and scaled to the render.

    image: [H, W, 3] float32 composited over ``background``.  alpha: [H, W] float32.  depth: [H, W] float32 (0 =
    unknown) or None.
    background: [3].  key: identifies (view, resolution, crop) for cached statistics of the image, None where its
    background changes; view: the same, whatever the background.
    """

    image: Tensor
    alpha: Tensor
    background: Tensor
    depth: Optional[Tensor] = None
    key: object = None
    view: object = None


@dataclass
class PartState:
    """The articulation phase's quantities of one step. K parts including the static slot 0.

    probs [N, K] soft assignment.  means_canonical [N, 3].  transforms [K, 4, 4]: start -> end (slot 0 identity).
    pairs [M] int64: indices of Gaussians with an observed pair; mu0, mu1 [M, 3]: their observed centres in both states
    (detached).
    knn [N, k] int64: neighbours in canonical space, self excluded.  target_rotation [K, 3, 3]: detached Kabsch fit of
    the pairs. repel_points [R, 3] in state-0 coordinates, or None.  extent: diagonal of the object's box.  spacing:
    median nearest-neighbour distance of the Gaussians.  hardness in [0, 1]: how far the soft-to-hard schedule has come.
    twists [K-1, 6]: logarithms of the movable parts' transforms where the phase has them at hand.  shared: what losses
    of this step have computed and others use too, by a key of their own (a graph in common: one backward pass for all
    of them); ``replace`` drops it.
    """

    probs: Tensor
    means_canonical: Tensor
    transforms: Tensor
    canonical_time: float | Tensor
    extent: float
    spacing: float
    pairs: Optional[Tensor] = None
    mu0: Optional[Tensor] = None
    mu1: Optional[Tensor] = None
    knn: Optional[Tensor] = None
    target_rotation: Optional[Tensor] = None
    repel_points: Optional[Tensor] = None
    hardness: float = 0.0
    twists: Optional[Tensor] = None
    shared: dict = field(default_factory=dict, init=False)

    def at(self, time: float) -> Tensor:
        """Motions [K, 4, 4] from canonical time to ``time`` (0 start, 1 end)."""
        span = time - self.canonical_time
        if self.twists is None:
            return se3.screw_at(self.transforms, span)
        return part_motions(self.twists * (span[1:, None].to(self.twists) if isinstance(span, Tensor) else span))


@dataclass
class LossInputs:
    """All a loss may look at in one training step. Fields a phase does not have are None.

    ``render``/``target``: the rendered view and its photograph.  ``gaussians``: the parameters as stored (canonical or
    single-state).
    ``parts``: articulation quantities.  ``step``/``total_steps``: of the phase, counted from 0.
    """

    step: int
    total_steps: int
    gaussians: GaussianTensors
    render: Optional[RenderOutput] = None
    target: Optional[Target] = None
    camera: Optional[Camera] = None
    parts: Optional[PartState] = None
    cache: dict = field(default_factory=dict)


@dataclass
class Loss:
    """Base of every loss.

    weight: factor in the total.  start, end: active while start <= step / total_steps < end (fractions of the phase).
    end_weight: when given, the weight moves from ``weight`` to it, geometrically, between start and end.
    every: looked at in one step of so many, with its weight multiplied by that number: the same on average at a part of
    the cost.

    Two class attributes tell a phase what to make. needs: of ``NEEDS``, what costs time and is made in steps where a
    loss asks for it (``pairs`` and ``rotations`` include ``parts``; all else of ``LossInputs`` is always there).  kind:
    of ``KINDS``. The ``image`` losses, which hold a render against its photograph, also fit the twin's Gaussians in the
    end; each kind has a chart in TensorBoard.
    """

    needs: ClassVar[frozenset[str]] = frozenset({"parts"})
    kind: ClassVar[str] = "own"

    weight: float = 1.0
    start: float = 0.0
    end: float = 1.0
    end_weight: Optional[float] = None
    every: int = 1

    def __init_subclass__(cls, **options):
        super().__init_subclass__(**options)
        cls.needs = frozenset(cls.needs)
        wrong = sorted(cls.needs - NEEDS.keys())
        if wrong:
            raise UserError(f"loss {cls.__name__}: needs '{wrong[0]}', which no phase makes; known: {', '.join(NEEDS)}")
        if cls.kind not in KINDS:
            raise UserError(f"loss {cls.__name__}: kind is '{cls.kind}', expected one of {', '.join(KINDS)}")
        if cls.needs & {"pairs", "rotations"}:
            cls.needs |= {"parts"}

    def active(self, step: int, total_steps: int) -> bool:
        return self.weight != 0 and step % self.every == 0 and self.start <= step / max(total_steps, 1) < self.end

    def weight_at(self, step: int, total_steps: int) -> float:
        return self.every * self._scheduled(step, total_steps)

    def _scheduled(self, step: int, total_steps: int) -> float:
        if self.end_weight is None:
            return self.weight
        span = max(self.end - self.start, 1e-9)
        x = min(max((step / max(total_steps, 1) - self.start) / span, 0.0), 1.0)
        return self.weight * (max(self.end_weight, 1e-12) / self.weight) ** x

    def compute(self, inputs: LossInputs) -> Optional[Tensor]:
        """The unweighted scalar, or None where this phase does not have what the loss needs."""
        raise NotImplementedError

    def __call__(self, inputs: LossInputs) -> Optional[Tensor]:
        if not self.active(inputs.step, inputs.total_steps):
            return None
        value = self.compute(inputs)
        return None if value is None else value * self.weight_at(inputs.step, inputs.total_steps)


def register_loss(name: str):
    """Decorator: make the class a dataclass and register it under ``name``."""

    def wrap(cls: type[Loss]) -> type[Loss]:
        return LOSSES.register(name)(dataclass(cls))

    return wrap
