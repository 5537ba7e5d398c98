"""How ArtGS, whose protocol the paper's tables follow, makes the surfaces that it scores, where p2gs's own way
differs."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal, Sequence

import numpy as np
import torch

from p2gs.gaussians.pose import pose
from p2gs.ops.knn import search_tree
from p2gs.ops.mesh import Mesh
from p2gs.surface.closed import FACES
from p2gs.surface.sightings import RESOLUTION, sight
from p2gs.types import ArticulatedObject, Camera, Part, UserError


@dataclass(frozen=True)
class SurfaceOptions:
    """``complete``, ``closed``, ``max_faces``, ``whole`` and ``cluster`` of ``phases.finish``
    (``models.finish.FinishConfig`` says what they mean)."""

    complete: bool = True
    closed: bool = True
    max_faces: int = FACES
    whole: Literal["joined", "separate"] = "joined"
    cluster: float = 0.0


def surface_options(run_dir: Path | str) -> SurfaceOptions:
    """The options in RUN/config.yaml; the defaults where the file or a key is missing. Raises UserError where it cannot
    be read."""
    import yaml

    path = Path(run_dir) / "config.yaml"
    if not path.is_file():
        return SurfaceOptions()
    try:
        tree = yaml.safe_load(path.read_text()) or {}
        given = (tree.get("phases") or {}).get("finish") or {}
        return SurfaceOptions(**{f.name: given[f.name] for f in fields(SurfaceOptions) if f.name in given})
    except (yaml.YAMLError, AttributeError, ValueError, TypeError, RecursionError, OverflowError) as err:
        raise UserError(
            f"{path}: phases.finish cannot be read ({err}); expected a mapping with "
            f"{', '.join(f.name for f in fields(SurfaceOptions))}"
        ) from err


def separate_whole(
    obj: ArticulatedObject, cameras: Sequence[tuple[int, Camera]], state: int, resolution: int = RESOLUTION
) -> Mesh:
    """The whole object's surface in one state from that state's views alone, without regard to parts.

    obj and cameras ((state, camera) pairs) in one coordinate system; resolution: voxels along the longest side.
    """
    still = ArticulatedObject(pose(obj, float(state)), torch.zeros_like(obj.part_ids), [Part(0)], 0.0)
    return sight(still, [(0, camera) for s, camera in cameras if s == state], resolution).surface(0)


def largest_clusters(obj: ArticulatedObject, eps: float) -> ArticulatedObject:
    """The twin without the Gaussians of moving parts that are not in their part's largest cluster.

    eps: DBSCAN's radius, units of ``obj``, with two points making a core (ArtGS's min_samples), for which the clusters
    are the connected components of the points nearer to each other than eps (Ester et al. 1996).
    """
    keep = torch.ones(len(obj.gaussians), dtype=torch.bool)
    for part in obj.parts:
        rows = (obj.part_ids == part.id).nonzero()[:, 0]
        if part.joint is not None and len(rows):
            keep[rows] = torch.from_numpy(
                _largest_component(obj.gaussians.means[rows].detach().cpu().double().numpy(), eps)
            )
    return replace(obj, gaussians=obj.gaussians[keep], part_ids=obj.part_ids[keep])


def _largest_component(points: np.ndarray, eps: float) -> np.ndarray:
    """[N] bool."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    pairs = search_tree(points).query_pairs(eps, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    label = connected_components(graph, directed=False)[1]
    return label == np.bincount(label).argmax()
