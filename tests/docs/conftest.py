"""A folder in which the docs' blocks can be run without leaving traces in the registries, and photographs to run them
on."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """An empty working directory; plugins registered and modules imported from it are forgotten afterwards."""
    from p2gs.callbacks.base import CALLBACKS
    from p2gs.config.run import import_builtins
    from p2gs.data.base import DATASETS
    from p2gs.losses.base import LOSSES
    from p2gs.models.stage import PHASES
    from p2gs.native import native
    from p2gs.render import RASTERIZERS, find_rasterizer

    import_builtins()
    for name in ("torch_ref", "cpu") if native is not None else ("torch_ref",):
        find_rasterizer(name)  # registers when first imported: before the registries are copied
    for registry in (LOSSES, CALLBACKS, PHASES, DATASETS, RASTERIZERS):
        monkeypatch.setattr(registry, "_items", dict(registry.items()))
        monkeypatch.setattr(registry, "paths", {})
    monkeypatch.delenv("P2GS_PLUGINS", raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if str(getattr(sys.modules[name], "__file__", None) or "").startswith(str(tmp_path)):
            del sys.modules[name]


@pytest.fixture(scope="session")
def photographs():
    """The demo cabinet in 8 views a state, 48 pixels."""
    from p2gs.data.generated.synthetic import make_object, synthetic_scene

    return synthetic_scene(make_object("demo", 0), 48, 8, 0, 0)


@pytest.fixture
def capture(photographs):
    """``capture(folder, **lens)``: what a user has: nerfstudio's transforms.json, RGB images on a grey wall, and masks,
    in both states."""
    import cv2
    import numpy as np

    from p2gs.data.generated.write import opengl_c2w

    def write(folder: Path, **lens) -> None:
        for state, name in enumerate(("start", "end")):
            frames = []
            for v in photographs.select(state):
                alpha = v.alpha.numpy()[..., None] / 255
                picture = (v.image.numpy() * alpha + 120 * (1 - alpha)).astype(np.uint8)
                for sub, pixels in (("images", picture[..., ::-1]), ("masks", v.alpha.numpy())):
                    (folder / name / sub).mkdir(parents=True, exist_ok=True)
                    cv2.imwrite(str(folder / name / sub / f"{v.name}.png"), pixels)
                frames.append({"file_path": f"images/{v.name}.png", "transform_matrix": opengl_c2w(v)})
            K = photographs.views[0].camera.K
            head = {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2]), **lens}
            (folder / name / "transforms.json").write_text(json.dumps({**head, "frames": frames}))

    return write
