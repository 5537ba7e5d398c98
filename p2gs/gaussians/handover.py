"""What one phase hands to the next: small named objects, saved as plain tensors (loadable with
``weights_only=True``)."""

from __future__ import annotations

import dataclasses
import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Optional

import torch
from torch import Tensor

from p2gs.gaussians.sealed import Damaged, check_seal, seal
from p2gs.types import GaussianTensors


@dataclass
class ViewCorrections:
    """What was wrong with a state's V training photographs, in the scene's order.

    motions [V, 4, 4] float64, internal units: the camera's viewmat is to be multiplied by it from the right.  log_gains
    [V, 3]: natural logarithm of how much brighter, in linear light, the photograph is than the state's mean one.
    growths [V]: by how much its mask is too wide, as a share of the photograph's long edge.
    """

    motions: Tensor
    log_gains: Tensor
    growths: Tensor


@dataclass
class StateGaussians:
    """A single state reconstructed. state: 0 start, 1 end.  corrections: of its photographs, where there are any."""

    state: int
    gaussians: GaussianTensors
    corrections: Optional[ViewCorrections] = None


@dataclass
class Registration:
    """Where the end state's reconstruction and cameras stand against the start's, as held-out photographs confirmed it.

    transform [4, 4] float64: end -> start, internal units.  log_gain [3]: natural logarithm of how much brighter, in
    linear light, the end's photographs are.  figures: what was measured, also of what is not applied.
    """

    transform: Tensor
    log_gain: Tensor
    figures: dict = field(default_factory=dict)

    @property
    def is_identity(self) -> bool:
        return not bool(self.log_gain.any()) and torch.equal(self.transform, torch.eye(4).to(self.transform))


@dataclass
class PartMotions:
    """The rigid motions of a twin's movable parts, start -> end.

    types: "revolute" or "prismatic" per movable part (part k is entry k - 1).  transforms [K-1, 4, 4] float64.
    confidence [K-1] in 0..1.  labels: part ids per Gaussian of the start and end reconstruction, int64.  margin: how
    clearly each label won, per Gaussian of the two states (internal length units; small = ambiguous).
    """

    types: list[str]
    transforms: Tensor
    confidence: Tensor
    labels: list[Tensor]
    margin: list[Tensor]
    diagnostics: dict = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.types)

    def with_motion(self, k: int, kind: str, transform: Tensor) -> "PartMotions":
        """The same with another type and transform [4, 4] for entry ``k``, or with one entry more (k = len; its labels
        and confidence are not known)."""
        types = [*self.types[:k], kind, *self.types[k + 1 :]]
        transforms = torch.cat([self.transforms[:k], transform[None], self.transforms[k + 1 :]])
        return dataclasses.replace(self, types=types, transforms=transforms)


@dataclass
class CanonicalGaussians:
    """The fused Gaussians at canonical time t_c = 1 - beta.

    betas [K] float64: one per part, all equal unless ``beta: per_part``.  labels [N], margin [N] as in ``PartMotions``
    (zero when no parts were discovered).  paired [N] bool: has an observed centre in both states, mu0 and mu1 [N, 3]
    (zero elsewhere).
    offsets [N, 2, 3]: position at state 0 and 1 minus canonical position where no motion is known (the paper's chords),
    else None.
    diagnostics: what fusion counted.
    """

    gaussians: GaussianTensors
    betas: Tensor
    labels: Tensor
    margin: Tensor
    paired: Tensor
    mu0: Tensor
    mu1: Tensor
    offsets: Optional[Tensor] = None
    diagnostics: dict = field(default_factory=dict)

    @property
    def canonical_times(self) -> Tensor:
        """[K], per part."""
        return 1.0 - self.betas


@dataclass
class Articulation:
    """What the articulation phase learned.

    gaussians at ``canonical_time``; probs [N, K] soft part assignment; motions as in ``PartMotions`` (transforms [K-1,
    4, 4] start -> end).
    """

    gaussians: GaussianTensors
    probs: Tensor
    types: list[str]
    transforms: Tensor
    confidence: Tensor
    canonical_time: float

    @property
    def part_ids(self) -> Tensor:
        return self.probs.argmax(dim=1)


_BUILT_IN = (
    GaussianTensors,
    ViewCorrections,
    StateGaussians,
    Registration,
    PartMotions,
    CanonicalGaussians,
    Articulation,
)
_CLASSES = {c.__name__: c for c in _BUILT_IN}


def handed_over(cls: type) -> type:
    """Decorator for a dataclass that a phase of your own hands over: fields are tensors, numbers, text, lists, dicts or
    other such classes.

    Raises ValueError where the class's name is taken.
    """
    known = _CLASSES.setdefault(cls.__name__, cls)
    if known.__qualname__ != cls.__qualname__ or known.__module__ != cls.__module__:
        raise ValueError(f"handed_over: there is another class {cls.__name__}, {known.__module__}.{known.__qualname__}")
    _CLASSES[cls.__name__] = cls
    return cls


def _pack(value):
    if dataclasses.is_dataclass(value):
        return {
            "__class__": type(value).__name__,
            **{f.name: _pack(getattr(value, f.name)) for f in dataclasses.fields(value)},
        }
    if isinstance(value, (list, tuple)):
        return [_pack(v) for v in value]
    if isinstance(value, dict):
        return {k: _pack(v) for k, v in value.items()}
    if isinstance(value, Tensor):
        return value.detach().cpu().clone()
    return value


def _unpack(value):
    if isinstance(value, dict) and "__class__" in value:
        fields = {k: _unpack(v) for k, v in value.items() if k != "__class__"}
        return _CLASSES[value["__class__"]](**fields)
    if isinstance(value, dict):
        return {k: _unpack(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_unpack(v) for v in value]
    return value


def save(value, path: Path, **header) -> None:
    """Write a hand-over object atomically (a killed run never leaves half a file), sealed. Raises OSError, for a full
    disk among others."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part, data = path.with_suffix(".part"), io.BytesIO()
    # into memory: torch tells no reason when a disk is full
    torch.save({"header": header, "value": _pack(value)}, data)
    part.write_bytes(data.getbuffer())
    seal(part, path)


def load(path: Path):
    """Returns (value, header). Raises ``sealed.Damaged`` for a file that is not as it was written, OSError where it
    cannot be read."""
    check_seal(path)
    try:
        stored = torch.load(path, weights_only=True)
        return _unpack(stored["value"]), stored["header"]
    except OSError:
        raise
    except Exception as err:  # whatever torch says of what is no checkpoint of ours
        raise Damaged(f"it is no result of a stage ({type(err).__name__})") from err
