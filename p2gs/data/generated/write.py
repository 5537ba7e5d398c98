"""Writes an object that is drawn, not photographed, as a scene in one of the published layouts, with ground truth."""

from __future__ import annotations

import json
import shutil
import tempfile
from pathlib import Path
from typing import Callable, Literal, Optional, Protocol, Sequence

import numpy as np
import torch

from p2gs.data.frames import STATES
from p2gs.data.generated.articulated import SyntheticJoint, SyntheticObject, concatenate
from p2gs.data.generated.synthetic import synthetic_scene
from p2gs.registry import suggest
from p2gs.types import TwoStateScene, UserError, View

Format = Literal["artgs", "dta", "paris"]


def opengl_c2w(view: View) -> list:
    """4x4 nested list, camera-to-world in OpenGL axes, of a view's camera."""
    c2w = np.linalg.inv(view.camera.viewmat.double().numpy())
    c2w[:3, 1:3] *= -1
    return c2w.tolist()


def _png(path: Path, image: np.ndarray) -> None:
    import cv2

    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 3]):
        raise UserError(f"{path}: cannot be written")


def _bgra(view: View) -> np.ndarray:
    return np.dstack([view.image.numpy()[..., ::-1], view.alpha.numpy()])


def _millimetres(view: View) -> np.ndarray:
    assert view.depth is not None
    return np.rint(view.depth.numpy().astype(np.float64) * 1000).astype(np.uint16)


def _json(path: Path, value) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


def joint_entry(joint: SyntheticJoint) -> dict:
    """A ``trans_info`` entry: axis, type, range l (start) to r (end) in degrees or scene units."""
    span, none = {"l": joint.start, "r": joint.end}, {"l": 0, "r": 0}
    turns = joint.type == "revolute"
    return {
        "axis": {"o": joint.origin.tolist(), "d": joint.axis.tolist()},
        "type": "rotate" if turns else "translate",
        "rotate": span if turns else none,
        "translate": none if turns else span,
    }


class Drawn(Protocol):
    """What can be written: the static part and the moving ones, joints of the latter, meshes by part and state."""

    @property
    def parts(self) -> Sequence: ...

    @property
    def joints(self) -> list[SyntheticJoint]: ...

    def mesh(self, part: int, t: float) -> tuple[np.ndarray, np.ndarray]: ...


def write_ground_truth(obj: Drawn, folder: Path) -> None:
    """``trans.json`` and ``{state}/{state}_[static_|dynamic[_i]_]rotate.ply``."""
    import trimesh

    joints = [joint_entry(j) for j in obj.joints]
    _json(folder / "trans.json", {"trans_info": joints[0] if len(joints) == 1 else joints})
    for t, state in enumerate(STATES):
        (folder / state).mkdir(parents=True, exist_ok=True)
        parts = [obj.mesh(k, float(t)) for k in range(len(obj.parts))]
        dynamic = ["dynamic"] if len(joints) == 1 else [f"dynamic_{i}" for i in range(len(joints))]
        for name, (v, f) in zip(["static", *dynamic, None], [*parts, concatenate(parts)], strict=True):
            path = folder / state / f"{state}_{name + '_' if name else ''}rotate.ply"
            content = trimesh.Trimesh(v, f, process=False).export(file_type="ply")
            assert isinstance(content, bytes)  # PLY is
            path.write_bytes(content)


def shared_K(views: Sequence[View], layout: str) -> np.ndarray:
    """The intrinsics [3, 3] of views whose layout has room for one K. Raises UserError where they differ."""
    Ks = np.stack([v.camera.K.double().numpy() for v in views])
    if np.abs(Ks - Ks[0]).max() > 1e-3:  # pixels
        raise UserError(f"the {layout} layout holds one focal length and centre, and these cameras differ; take artgs")
    return Ks[0]


def _intrinsics(view: View) -> dict[str, float]:
    K = view.camera.K.double().numpy()
    return {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}


def _write_artgs(scene: TwoStateScene, root: Path, depth: bool) -> Path:
    camera = scene.views[0].camera
    angles = (2 * np.arctan(0.5 * n / float(camera.K[i, i])) for i, n in enumerate((camera.width, camera.height)))
    head = dict(zip(("camera_angle_x", "camera_angle_y"), map(float, angles), strict=True))
    # ArtGS itself has one field of view with its centre in the middle; what differs is written with each frame
    centred = bool((camera.K[:2, 2] - torch.tensor([camera.width / 2, camera.height / 2])).abs().max() < 1e-3)
    plain = centred and all(
        (v.camera.width, v.camera.height) == (camera.width, camera.height)
        and torch.allclose(v.camera.K, camera.K, rtol=0, atol=1e-3)
        for v in scene.views
    )
    _json(root / "transforms_train.json", {**head, "frames": []})  # ArtGS only tests that it is there
    for s, state in enumerate(STATES):
        for split in ("train", "test"):
            frames = []
            for v in scene.select(s, split):
                path = f"{state}/{split}/rgba/{v.name}.png"
                _png(root / path, _bgra(v))
                if depth:
                    _png(root / path.replace("rgba", "depth"), _millimetres(v))
                frame = {"file_path": path, "time": float(s), "transform_matrix": opengl_c2w(v)}
                frames.append(frame if plain else frame | _intrinsics(v))
            _json(root / f"transforms_{split}_{state}.json", {**head, "frames": frames})
    return root / "gt"


def _write_dta(scene: TwoStateScene, root: Path, depth: bool) -> Path:
    views, lines = scene.select(split="train"), []
    K = shared_K(views, "dta")
    for v in views:
        name = f"{v.state}_{v.name}"
        _png(root / "color_segmented" / f"{name}.png", _bgra(v)[..., :3] * (v.alpha.numpy() > 127)[..., None])
        _png(root / "mask" / f"{name}.png", np.where(v.alpha.numpy() > 127, 255, 0).astype(np.uint8))
        if depth:
            _png(root / "depth_filtered" / f"{name}.png", _millimetres(v))
        numbers = ", ".join(repr(x) for row in opengl_c2w(v) for x in row)
        lines.append(f"frame_{name}:\n  cam_in_ob: [{numbers}]\n  time: {v.state}\n")
    (root / "init_keyframes.yml").write_text("".join(lines))
    np.savetxt(root / "cam_K.txt", K)
    return root / "gt"


def _write_paris(scene: TwoStateScene, root: Path, depth: bool) -> Path:
    for s, state in enumerate(STATES):
        for split in ("train", "test"):
            views = scene.select(s, split)
            cameras: dict = {"K": shared_K(views or scene.select(s), "paris").tolist()}
            for v in views:
                _png(root / "load" / state / split / f"{v.name}.png", _bgra(v))
                cameras[v.name] = opengl_c2w(v)
            _json(root / "load" / state / f"camera_{split}.json", cameras)
    return root / "data" / "textured_objs"


WRITERS = {"artgs": _write_artgs, "dta": _write_dta, "paris": _write_paris}


def write_scene(
    obj: SyntheticObject,
    out_dir,
    format: Format = "artgs",
    size: int = 400,
    train_views: int = 64,
    test_views: int = 10,
    seed: int = 0,
    depth: bool = True,
    recipe: Optional[dict] = None,
) -> Path:
    """Render both states and write images, cameras, depth (millimetres) and ground truth. Returns ``out_dir``.

    size: image side in pixels.  seed: of the cameras.  recipe: kept as ``synthetic.json``.  DTA has no test views,
    PARIS no depth. The folder appears only when all of it is written.  Raises UserError for an unknown format, sizes
    below 16 pixels, no training view, and where ``out_dir`` is not empty.
    """
    if size < 16 or train_views < 1 or test_views < 0:
        raise UserError(
            f"a scene needs images of at least 16 pixels and one training view, not size={size}, "
            f"train_views={train_views}"
        )
    kept = recipe or {"name": obj.name, "size": size, "seed": seed}

    def draw() -> TwoStateScene:
        return synthetic_scene(obj, size, train_views, test_views, seed)

    return write_views(draw, obj, Path(out_dir), format, depth, ("synthetic.json", kept))


def write_views(
    draw: Callable[[], TwoStateScene], obj: Drawn, root: Path, format: str, depth: bool, recipe: tuple[str, dict]
) -> Path:
    """Draw and write images, cameras, depth (millimetres), ground truth and the recipe (file name, content). The folder
    appears only when all of it is written.  Raises UserError for an unknown format, and where ``root`` is not empty."""
    if format not in WRITERS:
        raise UserError(f"unknown data format '{format}'{suggest(format, WRITERS)}")
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise UserError(f"{root}: is not an empty folder, and a generated scene does not overwrite files")
    root.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{root.name}-", dir=root.parent))
    try:
        write_ground_truth(obj, WRITERS[format](draw(), partial, depth))
        _json(partial / recipe[0], recipe[1])
        partial.chmod(0o755)
        partial.replace(root)
    finally:
        if partial.exists():
            shutil.rmtree(partial)
    return root
