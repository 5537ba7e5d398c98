"""Chamfer distance of part meshes, by the protocol of ArtGS (which the paper's tables follow), on the CPU.

Squared distances, mean over points, both directions summed, times 1000; 10,000 area-weighted points a mesh, three
sampling seeds, start and end averaged; small components of the prediction dropped. Every number comes with its floor,
what the true surface scores against another sampling of itself: differences below it mean nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Mapping, Sequence

import numpy as np

from p2gs.ops.knn import search_tree
from p2gs.ops.mesh import Mesh, Triangles, largest_components

POINTS = 10_000
SEEDS = (0, 1, 2)


@dataclass(frozen=True)
class PartMeshes:
    """One object in one state. static: the base.  movable: the moving parts.  whole: all of it; None joins the
    parts."""

    static: Triangles | None
    movable: Sequence[Triangles]
    whole: Triangles | None = None

    @property
    def all(self) -> Triangles | None:
        if self.whole is not None:
            return self.whole
        return join([m for m in (self.static, *self.movable) if m is not None])


@dataclass(frozen=True)
class ChamferReport:
    """static, movable (mean over parts), whole: x1000, mean of the states; None where a mesh is missing in every state.

    parts: one value per ground-truth movable part, None where it failed in some state.  failures: how many did.
    floors: of each of the three numbers, what the true surface scores against itself sampled anew.
    """

    static: float | None
    movable: float | None
    whole: float | None
    parts: list[float | None]
    failures: int
    floors: dict[str, float | None]

    def to_dict(self) -> dict:
        """Plain numbers, for JSON: {static|movable|whole: {value, floor}, parts, failures}."""
        named = {"static": self.static, "movable": self.movable, "whole": self.whole}
        return {k: {"value": v, "floor": self.floors[k]} for k, v in named.items()} | {
            "parts": self.parts,
            "failures": self.failures,
        }


def read_surface(path: Path | str | None) -> Triangles | None:
    """A mesh file that trimesh reads (ply, obj, stl, glb), scene graphs joined; None for no path or no such file."""
    import trimesh

    loaded: Any = trimesh.load  # of a file it makes what ``force`` says
    return loaded(path, force="mesh", process=False) if path is not None and Path(path).is_file() else None


def read_part_meshes(
    whole: Path | str | None, static: Path | str | None, movable: Sequence[Path | str | None]
) -> PartMeshes:
    """The meshes of one state from their files; a movable part without a file becomes an empty mesh (it keeps its
    number)."""
    empty = Mesh.empty()
    return PartMeshes(read_surface(static), [read_surface(m) or empty for m in movable], read_surface(whole))


def is_empty(mesh: Triangles | None) -> bool:
    """No mesh, no triangles, or no area."""
    return mesh is None or len(mesh.faces) == 0 or not surface_area(mesh) > 0


def triangles(mesh: Triangles) -> np.ndarray:
    """[F, 3, 3] float64."""
    return np.asarray(mesh.vertices, dtype=np.float64)[np.asarray(mesh.faces, dtype=np.int64)]


def surface_area(mesh: Triangles) -> float:
    """Total area of the triangles."""
    return float(_areas(triangles(mesh)).sum())


def _areas(t: np.ndarray) -> np.ndarray:
    return 0.5 * np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=-1)


def join(meshes: Sequence[Triangles]) -> Mesh | None:
    """One mesh out of several; None out of none."""
    return Mesh.join([Mesh.of(m) for m in meshes]) if meshes else None


def sample_surface(mesh: Triangles, count: int, seed: int | Sequence[int] = 0) -> np.ndarray:
    """Points uniform by area, [count, 3] float64; the same for the same seed. Raises ValueError for a mesh without
    area."""
    t = triangles(mesh)
    edges = np.cumsum(_areas(t))
    if len(edges) == 0 or not edges[-1] > 0:
        raise ValueError("a mesh without area has no surface to sample")
    rng = np.random.default_rng(seed)
    face = np.searchsorted(edges, rng.random(count) * edges[-1], side="right").clip(max=len(edges) - 1)
    u, v = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    a, b, c = t[face].transpose(1, 0, 2)
    return (1 - u) * a + u * (1 - v) * b + u * v * c


def chamfer_distance(a: np.ndarray, b: np.ndarray) -> float:
    """mean over a of min |a - b|^2 + mean over b of min |b - a|^2, for points [N, 3] and [M, 3] (not times 1000).

    >>> chamfer_distance(np.zeros((1, 3)), np.array([[1.0, 0, 0], [2.0, 0, 0]]))
    3.5
    """
    ab, _ = search_tree(b).query(a)
    ba, _ = search_tree(a).query(b)
    return float((ab**2).mean() + (ba**2).mean())


def sampling_floor(area: float, count: int = POINTS) -> float:
    """1000 * 2 A / (pi N): the expected number for two independent samplings of one smooth sheet of area A.

    Surfaces with layers nearer to each other than the samples are (thin walls modelled from both sides) score less.

    >>> round(sampling_floor(5.2), 3)
    0.331
    """
    return 1000 * 2 * area / (math.pi * count)


def mesh_chamfer(pred: Triangles, gt: Triangles, count: int = POINTS, seeds: Sequence[int] = SEEDS) -> float:
    """1000 x the Chamfer distance of two surfaces, mean over the sampling seeds."""
    values = [chamfer_distance(sample_surface(pred, count, (s, 0)), sample_surface(gt, count, (s, 1))) for s in seeds]
    return 1000 * float(np.mean(values))


def match_parts(pred: Mapping[str, PartMeshes], gt: Mapping[str, PartMeshes], count: int = 1000) -> dict[int, int]:
    """gt part -> predicted part by least Chamfer distance summed over the states (Hungarian), for ``evaluate_joints``
    as well.

    What is left over on either side, and parts without a surface, stay unmatched. Preferable to matching by joints when
    more parts were predicted than there are.
    """
    from scipy.optimize import linear_sum_assignment

    parts = len(next(iter(gt.values())).movable), len(next(iter(pred.values())).movable)
    cost = np.zeros(parts)
    for state, truth in gt.items():
        for i, g in enumerate(truth.movable):
            for j, p in enumerate(pred[state].movable):
                cost[i, j] += 1e9 if is_empty(p) or is_empty(g) else mesh_chamfer(p, g, count, seeds=(0,))
    return {int(i): int(j) for i, j in zip(*linear_sum_assignment(cost), strict=True) if cost[i, j] < 1e9}


def _mean(values: Sequence[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None


def evaluate_chamfer(
    pred: Mapping[str, PartMeshes],
    gt: Mapping[str, PartMeshes],
    assignment: Mapping[int, int],
    *,
    count: int = POINTS,
    seeds: Sequence[int] = SEEDS,
    clean: float = 0.1,
) -> ChamferReport:
    """All Chamfer numbers of one object.

    pred, gt: state name ("start", "end") -> meshes, the states of ``gt`` are evaluated.  assignment: gt movable part ->
    predicted one (``JointReport.assignment`` or ``match_parts``).  clean: components of a *predicted* mesh below this
    fraction of its largest are dropped (ground truth is taken as it is, interior faces included); a whole that is its
    parts joined is what is left of these: a door may well have fewer triangles than a tenth of the base.

    >>> box = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    >>> shift = Mesh(box.vertices + [0, 0, 0.1], box.faces)
    >>> states = {"start": PartMeshes(box, [box])}, {"start": PartMeshes(box, [shift])}
    >>> report = evaluate_chamfer(*states, {0: 0})
    >>> 20 < report.movable < 20.1, report.static < 0.04
    (True, True)
    """

    def score(p: Triangles | None, g: Triangles | None) -> float | None:
        return None if p is None or g is None or is_empty(p) or is_empty(g) else mesh_chamfer(p, g, count, seeds)

    def cleaned(mesh: Triangles) -> Triangles:
        return mesh if clean <= 0 else largest_components(Mesh.of(mesh), clean, weld=True)

    def floor(meshes: Sequence[Triangles | None]) -> list[float]:
        return [mesh_chamfer(g, g, count, seeds) for g in meshes if g is not None and not is_empty(g)]

    static, whole, parts = [], [], []
    floors = {"static": [], "movable": [], "whole": []}
    for state, truth in gt.items():
        made = pred[state]
        static_part, all_parts = (None if m is None else cleaned(m) for m in (made.static, made.whole))
        found = PartMeshes(static_part, [cleaned(m) for m in made.movable], all_parts)
        static.append(score(found.static, truth.static))
        whole.append(score(found.all, truth.all))
        partners = [found.movable[assignment[i]] if i in assignment else None for i in range(len(truth.movable))]
        parts.append([score(p, g) for p, g in zip(partners, truth.movable, strict=True)])
        for name, meshes in (("static", [truth.static]), ("movable", truth.movable), ("whole", [truth.all])):
            floors[name] += floor(meshes)
    per_part = [None if None in values else float(np.mean(values)) for values in zip(*parts, strict=True)]
    known = {name: _mean(values) for name, values in floors.items()}
    return ChamferReport(_mean(static), _mean(per_part), _mean(whole), per_part, per_part.count(None), known)
