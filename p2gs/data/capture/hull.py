"""The body that the outlines of many photographs have in common (visual hull, Laurentini 1994, DOI 10.1109/34.273735).

Outlines are those of a coarse splat: a plain side is a fog there, and a dark inside is explained by what is behind it
in one photograph or another. What nearly all photographs agree on is the object's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2gs.data.capture.coarse import REGION, Region
from p2gs.types import Camera

CELL = 0.01  # over the cameras' distance: one and a half pixels of a coarse picture
IN_HULL = 0.93  # share of the photographs that must show a point within the outline; a ragged outline misses some
FEWEST = 3  # photographs that must show a point at all
MIDDLE = 0.2  # over the cameras' distance: how near to where they look a body is likely to be


@dataclass(frozen=True)
class Hull:
    """points: [M, 3], the middles of the cells.  step: the cells' width."""

    points: np.ndarray
    step: float

    def outline(self, camera: Camera) -> np.ndarray:
        """[h, w] bool: the pixels that a cell covers, each drawn as a disc as wide as its diagonal."""
        import cv2

        x, y, z, shown = _projected(self.points, camera)
        out = np.zeros((camera.height, camera.width), np.uint8)
        radius = np.ceil(0.5 * np.sqrt(2) * self.step * float(camera.K[0, 0]) / np.maximum(z, 1e-9)).astype(int)
        for r in np.unique(radius[shown]):
            cells, of = np.zeros_like(out), shown & (radius == r)
            cells[y[of], x[of]] = 1
            disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * r - 1, 2 * r - 1))
            out = np.maximum(out, cv2.dilate(cells, disc))
        return out > 0


def hull_of(region: Region, outlines: list[tuple[Camera, np.ndarray]]) -> Hull:
    """The body in the region's middle that ``outlines`` [h, w] bool have in common, and what hangs in the air: it must
    hang on that body, as a front does whose drawer's sides are too thin to show, while what stands about stands on the
    floor or leans on a wall. But what most photographs do not show is not what they were taken of (fog before a bright
    ceiling). Without cells where there is no body.

    outlines: the camera and what is inside the outline, by photograph.
    """
    from scipy.ndimage import label

    step, reach = CELL * region.fine, 1.1 * REGION * region.distance
    low, high = (region.centre - reach, region.centre + reach) if region.box is None else region.box
    sides = [np.arange(a, b + step, step) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*sides, indexing="ij"), -1).reshape(-1, 3)
    above = (points @ region.planes[:, :3].T - region.planes[:, 3]).min(1)
    free = np.flatnonzero((above > 0) & (region.box is None or region.holds(points)))
    solid = np.zeros(len(points), bool)
    solid[free], seen = in_common(points[free], outlines)
    bodies = np.asarray(label(solid.reshape([len(s) for s in sides]), np.ones((3, 3, 3)))[0], np.int64).ravel()  # type: ignore[index]
    away = np.linalg.norm(points - region.centre, axis=1) / region.distance
    weight = np.bincount(bodies, np.exp(-((away / MIDDLE) ** 2)))
    weight[0] = 0.0
    lowest, looks = np.full(len(weight), np.inf), np.zeros(len(points))
    np.minimum.at(lowest, bodies, above)
    looks[free] = seen
    looks = np.bincount(bodies, looks) / np.maximum(np.bincount(bodies), 1)
    kept = (lowest > step) & (looks > len(outlines) / 2)  # a cell of air beneath
    kept[weight.argmax()], kept[0] = True, False
    return Hull(points[kept[bodies]], step)


def in_common(points: np.ndarray, outlines: list[tuple[Camera, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Of points [N, 3]: which lie within nearly all outlines (camera and [h, w] bool) that can show them, and how many
    can."""
    seen, inside = np.zeros(len(points)), np.zeros(len(points))
    for camera, outline in outlines:
        x, y, _, shown = _projected(points, camera)
        seen += shown
        inside[shown] += outline[y[shown], x[shown]]
    return (seen >= FEWEST) & (inside >= IN_HULL * seen), seen


def agreement(outlines: list[tuple[Camera, np.ndarray]], box: np.ndarray, cells: int = 48) -> list[float]:
    """Of each outline the share (intersection over union) that it has in common with the body that nearly all of them
    show within ``box`` [2, 3]: about 1 where they are of one thing. cells: along the box's longest side."""
    step = float((box[1] - box[0]).max()) / cells
    sides = [np.arange(a + step / 2, b, step) for a, b in zip(*box, strict=True)]
    points = np.stack(np.meshgrid(*sides, indexing="ij"), -1).reshape(-1, 3)
    body = Hull(points[in_common(points, outlines)[0]], step)
    out = []
    for camera, outline in outlines:
        drawn = body.outline(camera)
        out.append(float((drawn & outline).sum() / max((drawn | outline).sum(), 1)))
    return out


def _projected(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pixel column, row and depth of points [N, 3], and which the picture shows."""
    M, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
    local = points @ M[:3, :3].T + M[:3, 3]
    z = local[:, 2]
    front = np.where(z > 0, z, 1.0)
    x = np.floor(local[:, 0] / front * K[0, 0] + K[0, 2])
    y = np.floor(local[:, 1] / front * K[1, 1] + K[1, 2])
    shown = (z > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    return np.where(shown, x, 0).astype(int), np.where(shown, y, 0).astype(int), z, shown
