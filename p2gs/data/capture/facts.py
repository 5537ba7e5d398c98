"""What ``capture.json`` tells of a scene's images, the states' bias and the colours."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from p2gs.data.capture.joint import state_bias
from p2gs.data.capture.model import Model
from p2gs.data.capture.photos import Shot

FORMAT = "p2gs-capture/1"


def facts_of(
    model: Model,
    shots: list[Shot],
    left_out: dict[str, tuple[str, str]],
    files: dict[str, str],
    found: dict[int, np.ndarray],
    box: np.ndarray,
) -> dict:
    """What JSON knows of a scene.

    model: in scene coordinates.  shots: photographs that were used, files: where they are in the scene, by name;
    left_out: source and reason of the others, by name.  found: gains (``gains.photo_gains``).  box: the object's,
    [2, 3].
    """
    images = []
    for shot in shots:
        file = files.get(shot.name)
        reason = None if file else "could not be placed well among the others"
        images.append({"state": shot.name.split("/")[0], "source": shot.source, "file": file, "reason": reason})
    images += [{"state": n.split("/")[0], "source": s, "file": None, "reason": why} for n, (s, why) in left_out.items()]
    bias, (_, distance) = state_bias(model), model.centre()
    known = bool(np.isfinite(bias.shift))
    return {
        "format": FORMAT,
        "images": images,
        "bias": {
            "shift": bias.shift if known else None,
            "turn_degrees": bias.turn if known else None,
            "points": bias.points,
            "share_of_distance": bias.shift / distance if known else None,
        },
        "share_of_points_in_both_states": bias.share,
        "lenses": {str(k): {**asdict(lens), "params": lens.params.tolist()} for k, lens in model.lenses.items()},
        "gains": {
            files[p.name]: np.exp(found[k]).round(4).tolist() for k, p in model.photos.items() if p.name in files
        },
        "object_box": box.tolist(),
    }
