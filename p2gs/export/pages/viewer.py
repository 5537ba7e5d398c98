"""The twin in the browser (viser, optional): every part with a slider for its joint, colours as photographed or by
part."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Optional, Sequence

import numpy as np
import torch

from p2gs.gaussians.pose import part_transform
from p2gs.gaussians.twin_json import load_twin
from p2gs.gaussians.views import NamedCamera, bounds, read_cameras
from p2gs.ops.palette import part_colour
from p2gs.ops.sh import dc_to_rgb
from p2gs.ops.so3 import matrix_to_quat, quat_to_matrix
from p2gs.types import ArticulatedObject, UserError

FRUSTA = 24  # a state


def splat_arrays(obj: ArticulatedObject, part: int) -> dict[str, np.ndarray]:
    """What viser draws of the ``part``-th part at canonical time, float32: centers [n, 3], covariances [n, 3, 3], rgbs
    [n, 3] in 0..1 (without view dependence), opacities [n, 1]."""
    g = obj.gaussians[obj.part_ids == obj.parts[part].id]
    RS = quat_to_matrix(g.quats) * g.log_scales.exp()[:, None, :]
    arrays = {
        "centers": g.means,
        "covariances": RS @ RS.transpose(1, 2),
        "rgbs": dc_to_rgb(g.sh[:, 0]).clamp(0, 1),
        "opacities": torch.sigmoid(g.opacity_logits)[:, None],
    }
    return {name: value.detach().float().cpu().numpy() for name, value in arrays.items()}


class Stage:
    """A viser server that shows one twin, which may change (training): sliders stay where the user put them.

    Raises UserError where viser is not installed.
    """

    def __init__(self, label: str, host: str = "127.0.0.1", port: int = 8080):
        try:
            import viser
        except ImportError as err:
            raise UserError("the viewer needs viser, which is not installed: pip install 'p2gs[viewer]'") from err
        self.server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
        self.server.scene.set_up_direction("+z")
        self.by_part = self.server.gui.add_checkbox("colour by part", initial_value=False)
        self.by_part.on_update(lambda _: self._paint())
        self.axes = self.server.gui.add_checkbox("joint axes", initial_value=True)
        self.axes.on_update(lambda _: self._show_axes())
        self.obj: Optional[ArticulatedObject] = None
        self.times: dict[int, float] = {}  # part id -> state
        self.sliders: dict[int, object] = {}
        self.frames: dict[int, object] = {}
        self.splats: dict[int, tuple] = {}
        self.lines: dict[int, object] = {}

    def show(self, obj: ArticulatedObject) -> None:
        """Draw this twin from now on. Parts that it does not have any more vanish, with their sliders."""
        self.obj = obj
        alive = {p.id for p in obj.parts}
        for shown in (self.frames, self.sliders, self.lines):
            for gone in set(shown) - alive:
                shown.pop(gone).remove()
        self.splats = {k: v for k, v in self.splats.items() if k in alive}
        for k, part in enumerate(obj.parts):
            if part.id not in self.frames:
                self.frames[part.id] = self.server.scene.add_frame(f"/part_{part.id}", show_axes=False)
            arrays = splat_arrays(obj, k)
            if len(arrays["centers"]):  # of the same name as before: takes its place
                handle = self.server.scene.add_gaussian_splats(f"/part_{part.id}/splats", **arrays)
                self.splats[part.id] = (handle, arrays["rgbs"], part_colour(part.id))
            elif part.id in self.splats:
                self.splats.pop(part.id)[0].remove()
            if part.joint is not None:
                self._add_slider(part)
                self._add_axis(part)
            place(self.frames[part.id], obj, k, self.times.get(part.id, 0.0))
        if self.by_part.value:
            self._paint()

    def _add_slider(self, part) -> None:
        if part.id in self.sliders:
            return
        label = f"part {part.id} ({part.joint.type})"
        slider = self.server.gui.add_slider(label, min=0.0, max=1.0, step=0.01, initial_value=0.0)
        slider.on_update(lambda event, i=part.id: self.move(i, event.target.value))
        self.sliders[part.id] = slider

    def _add_axis(self, part) -> None:
        """The joint's axis as a line through its origin, half as long as the object."""
        half = 0.25 * float((bounds(self.obj)[1] - bounds(self.obj)[0]).max())
        ends = torch.stack([part.joint.origin - half * part.joint.axis, part.joint.origin + half * part.joint.axis])
        colour = tuple(int(255 * c) for c in part_colour(part.id))
        points = ends.numpy().astype(np.float32)[None]
        self.lines[part.id] = self.server.scene.add_line_segments(f"/axis_{part.id}", points, colour, line_width=4.0)
        self.lines[part.id].visible = bool(self.axes.value)

    def move(self, part_id: int, t: float) -> None:
        """Put a part where it is at state t."""
        self.times[part_id] = float(t)
        k = next(i for i, p in enumerate(self.obj.parts) if p.id == part_id)
        place(self.frames[part_id], self.obj, k, float(t))

    def _paint(self) -> None:
        for splat, rgbs, colour in self.splats.values():
            splat.rgbs = (
                np.broadcast_to(np.asarray(colour, np.float32), rgbs.shape).copy() if self.by_part.value else rgbs
            )

    def _show_axes(self) -> None:
        for line in self.lines.values():
            line.visible = bool(self.axes.value)

    def add_cameras(self, cameras: Sequence[NamedCamera]) -> None:
        """A frustum a camera (grey: start, blue: end), hidden until their box is ticked."""
        if not cameras:
            return
        box = self.server.gui.add_checkbox("cameras", initial_value=False)
        size = 0.05 * float((bounds(self.obj)[1] - bounds(self.obj)[0]).max()) if self.obj is not None else 0.05
        handles = []
        for state, colour in ((0, (120, 120, 120)), (1, (60, 110, 200))):
            mine = [c for c in cameras if c.state == state and c.split == "train"]
            for named in mine[:: max(1, len(mine) // FRUSTA)]:
                cam = named.camera
                R = cam.viewmat[:3, :3].double().T
                handle = self.server.scene.add_camera_frustum(
                    f"/cameras/{state}/{named.name}",
                    fov=2 * float(np.arctan(cam.height / 2 / float(cam.K[1, 1]))),
                    aspect=cam.width / cam.height,
                    scale=size,
                    color=colour,
                    wxyz=matrix_to_quat(R).numpy(),
                    position=(-R @ cam.viewmat[:3, 3].double()).numpy(),
                    visible=False,
                )
                handles.append(handle)

        @box.on_update
        def _(event) -> None:
            for handle in handles:
                handle.visible = bool(box.value)

    def add_picture(self, path: Path, label: str) -> None:
        """An image file in the panel, where it is there."""
        import cv2

        image = cv2.imread(str(path)) if path.is_file() else None
        if image is not None:
            self.server.gui.add_image(np.ascontiguousarray(image[..., ::-1]), label=label)


def open_viewer(run_dir: Path | str, host: str = "127.0.0.1", port: int = 8080):
    """Start the server for a run's twin and return it. Raises UserError where viser is not installed or the run has no
    twin."""
    run_dir = Path(run_dir)
    obj = load_twin(run_dir)
    stage = Stage(f"p2gs {run_dir.name}", host, port)
    stage.show(obj)
    stage.add_cameras(read_cameras(run_dir / "cameras.json"))
    stage.add_picture(run_dir / "media" / "compare.png", "photographs and twin, start and end")
    return stage.server


def place(frame, obj: ArticulatedObject, part: int, t: float) -> None:
    """Put a part's frame where the part is at state t."""
    T = part_transform(obj, part, t)
    frame.wxyz, frame.position = matrix_to_quat(T[:3, :3]).numpy(), T[:3, 3].numpy()


def serve(run_dir: Path | str, host: str, port: int) -> None:
    """Until Ctrl-C."""
    server = open_viewer(run_dir, host, port)
    print(f"http://{host}:{server.get_port()}  (Ctrl-C ends it)", flush=True)
    while True:
        time.sleep(3600)
