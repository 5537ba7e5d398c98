"""How surely each photograph's camera is known: the spread of its centre by what it shows of the points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from p2gs.data.capture.model import Model

UNSURE = 0.002  # of the cameras' distance: 4 mm at 2 m, a pixel or two at the object


def spreads(model: Model) -> dict[int, float]:
    """Standard deviation of each camera's centre in the model's units, by the photograph's own reprojection errors and
    with the points taken to be known; infinite where they do not fix it.

    The covariance is s^2 (J^T J)^-1 with J the projections' Jacobian by the six of the pose. Points at one pixel (a
    corner that counts several times) are one.
    """
    rows, images, error = model.errors()
    out = {}
    for key, photo in model.photos.items():
        mine = images == key
        xy, first = np.unique(photo.xy[photo.point >= 0].round(3), axis=0, return_index=True)
        if len(xy) < 3:
            out[key] = np.inf
            continue
        local = model.xyz[rows[mine][first]] @ photo.viewmat[:3, :3].T + photo.viewmat[:3, 3]
        lens, small = model.lenses[photo.lens], 1e-6 * float(np.linalg.norm(local, axis=1).mean())
        steps = [np.cross(axis, local) * 1e-6 for axis in np.eye(3)] + [axis * small for axis in np.eye(3)]
        size = [1e-6] * 3 + [small] * 3
        here = lens.project(local)
        J = np.stack([(lens.project(local + d) - here) / s for d, s in zip(steps, size, strict=True)], 2)
        A = J.reshape(-1, 6).T @ J.reshape(-1, 6)
        variance = float((error[mine][first] ** 2).mean()) / 2
        fixed = np.linalg.cond(A) < 1e16
        out[key] = float(np.sqrt(variance * np.trace(np.linalg.inv(A)[3:, 3:]))) if fixed else np.inf
    return out


def without_unsure(model: Model) -> Model:
    """The model without photographs whose cameras are not known to ``UNSURE``: they would be trained on from places
    where they were not taken."""
    distance, spread = model.centre()[1], spreads(model)
    return replace(model, photos={k: p for k, p in model.photos.items() if spread[k] <= UNSURE * distance})
