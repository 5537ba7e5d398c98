"""A triangle mesh with vertex colours, its connected components, and what is left without the small ones."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, Sequence

import numpy as np


class Triangles(Protocol):
    """vertices [V, 3] and triangles ``faces`` [F, 3]: what ``Mesh`` and trimesh.Trimesh have."""

    @property
    def vertices(self) -> np.ndarray: ...

    @property
    def faces(self) -> np.ndarray: ...


@dataclass
class Mesh:
    """vertices [V, 3] float64, faces [F, 3] int64, colours [V, 3] uint8 (black where none are given), guessed [F] bool:
    faces that close what nobody saw (none where it is not said)."""

    vertices: np.ndarray
    faces: np.ndarray
    colours: np.ndarray = field(default=None)  # type: ignore[assignment]
    guessed: np.ndarray = field(default=None)  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if self.colours is None:
            self.colours = np.zeros((len(self.vertices), 3), np.uint8)
        if self.guessed is None:
            self.guessed = np.zeros(len(self.faces), bool)

    def transformed(self, T: np.ndarray) -> "Mesh":
        """The mesh after the affine map T [4, 4]."""
        return Mesh(self.vertices @ T[:3, :3].T + T[:3, 3], self.faces, self.colours, self.guessed)

    def only(self, kept: np.ndarray) -> "Mesh":
        """The triangles ``kept`` [F] bool, and the vertices that they have."""
        return Mesh(self.vertices, self.faces[kept], self.colours, self.guessed[kept]).without_unused()

    def without_unused(self) -> "Mesh":
        """Without vertices that no triangle has."""
        used, renumbered = np.unique(self.faces, return_inverse=True)
        return Mesh(self.vertices[used], renumbered.reshape(-1, 3), self.colours[used], self.guessed)

    @staticmethod
    def join(meshes: Sequence["Mesh"]) -> "Mesh":
        """One mesh of several."""
        offsets = np.cumsum([0] + [len(m.vertices) for m in meshes])
        faces = [m.faces + o for m, o in zip(meshes, offsets, strict=False)]
        lists = ([m.vertices for m in meshes], faces, [m.colours for m in meshes], [m.guessed for m in meshes])
        return Mesh(*(np.concatenate(x) for x in lists))

    @staticmethod
    def empty() -> "Mesh":
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3), np.uint8))

    @staticmethod
    def of(mesh: Triangles) -> "Mesh":
        """The shape of any mesh, black."""
        return Mesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))


def components(mesh: Triangles, weld: bool = False) -> np.ndarray:
    """Connected component [F] of each triangle. weld: vertices at the same place count as one, so that an unwelded mesh
    does not fall apart."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    f, n = np.asarray(mesh.faces, dtype=np.int64), len(mesh.vertices)
    if weld:
        f = np.unique(np.asarray(mesh.vertices), axis=0, return_inverse=True)[1].reshape(-1)[f]
    graph = coo_matrix((np.ones(2 * len(f)), (np.r_[f[:, 0], f[:, 1]], np.r_[f[:, 1], f[:, 2]])), (n, n))
    return connected_components(graph, directed=False)[1][f[:, 0]]


def largest_components(mesh: Mesh, fraction: float = 0.1, weld: bool = False) -> Mesh:
    """Without the connected components that have fewer than ``fraction`` of the largest one's triangles. weld: see
    ``components``."""
    if not len(mesh.faces):
        return mesh
    label = components(mesh, weld)
    count = np.bincount(label)
    return mesh.only(count[label] >= fraction * count.max())


def connected(mesh: Mesh) -> list[Mesh]:
    """The mesh's connected components."""
    label = components(mesh)
    return [mesh.only(label == k) for k in np.unique(label)]
