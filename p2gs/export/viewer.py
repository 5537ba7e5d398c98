"""The twin in the browser (viser, optional): every part with a slider for its joint, colours as photographed or by part."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import torch

from p2gs.export.pose import part_transform
from p2gs.export.twin_json import load_twin
from p2gs.ops.palette import part_colour
from p2gs.ops.sh import dc_to_rgb
from p2gs.ops.so3 import matrix_to_quat, quat_to_matrix
from p2gs.types import ArticulatedObject, UserError


def splat_arrays(obj: ArticulatedObject, part: int) -> dict[str, np.ndarray]:
    """What viser draws of the ``part``-th part at canonical time, float32: centers [n, 3], covariances [n, 3, 3], rgbs [n, 3] in 0..1
    (without view dependence), opacities [n, 1]."""
    g = obj.gaussians[obj.part_ids == obj.parts[part].id]
    RS = quat_to_matrix(g.quats) * g.log_scales.exp()[:, None, :]
    arrays = {
        "centers": g.means,
        "covariances": RS @ RS.transpose(1, 2),
        "rgbs": dc_to_rgb(g.sh[:, 0]).clamp(0, 1),
        "opacities": torch.sigmoid(g.opacity_logits)[:, None],
    }
    return {name: value.detach().float().cpu().numpy() for name, value in arrays.items()}


def open_viewer(run_dir: Path | str, host: str = "127.0.0.1", port: int = 8080):
    """Start the server for a run's twin and return it. Raises UserError where viser is not installed or the run has no twin."""
    obj = load_twin(run_dir)
    try:
        import viser
    except ImportError as err:
        raise UserError("the viewer needs viser, which is not installed: pip install 'p2gs[viewer]'") from err
    server = viser.ViserServer(host=host, port=port, label=f"p2gs {Path(run_dir).name}", verbose=False)
    server.scene.set_up_direction("+z")
    by_part = server.gui.add_checkbox("colour by part", initial_value=False)
    frames, splats = [], []
    for k, part in enumerate(obj.parts):
        arrays = splat_arrays(obj, k)
        frames.append(server.scene.add_frame(f"/part_{part.id}", show_axes=False))
        splats.append((server.scene.add_gaussian_splats(f"/part_{part.id}/splats", **arrays), arrays["rgbs"], part_colour(part.id)))
        place(frames[k], obj, k, 0.0)
        if part.joint is not None:
            label = f"part {part.id} ({part.joint.type})"
            slider = server.gui.add_slider(label, min=0.0, max=1.0, step=0.01, initial_value=0.0)
            slider.on_update(lambda event, k=k: place(frames[k], obj, k, event.target.value))

    @by_part.on_update
    def _(event) -> None:
        for splat, rgbs, colour in splats:
            splat.rgbs = np.broadcast_to(np.asarray(colour, np.float32), rgbs.shape).copy() if by_part.value else rgbs

    return server


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
