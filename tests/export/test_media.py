"""Pictures: the right view, the right pixels, the right files."""

import numpy as np
import pytest
import torch
from toy import ring, toy_scene, toy_twin

from p2gs.export.pages.media import framed, render_parts, render_plain
from p2gs.export.pages.states import render_states
from p2gs.export.run_folder import write_twin
from p2gs.gaussians.frame import object_to_input
from p2gs.gaussians.paint import draw, joint_strokes, part_coloured
from p2gs.gaussians.pose import pose
from p2gs.gaussians.twin_json import load_twin
from p2gs.gaussians.views import best_camera, bounds, orbit, point_labels, read_cameras, scene_cameras
from p2gs.ops.palette import part_colour
from p2gs.types import Similarity, UserError

SIM = Similarity(2.0, (0.2, 0.1, -0.3))


def photograph(state, camera):
    out = draw(pose(toy_twin(SIM), float(state)), camera, 0.0)
    return out.colour / out.alpha.clamp_min(1e-6)[..., None], out.alpha


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    write_twin(toy_twin(SIM), folder, toy_scene(SIM, n=6, size=96, render=photograph))
    return folder


def read(path):
    import cv2

    return cv2.imread(str(path))[..., ::-1].astype(float) / 255


def test_a_new_twin_removes_what_was_made_of_the_old_one(tmp_path):
    old = ["twin.urdf", "twin.glb", "meshes/start/part_7.ply", "assets/a.obj", "metrics.json", "report.html"]
    kept = ["config.yaml", "checkpoints/articulation.pt", "notes.txt"]
    for name in old + kept:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("old")
    write_twin(toy_twin(SIM), tmp_path, toy_scene(SIM, n=2, size=16), media=False)
    assert not any((tmp_path / name).exists() for name in old)
    assert all((tmp_path / name).read_text() == "old" for name in kept) and (tmp_path / "twin.json").exists()


def test_write_twin_leaves_the_contract(run):
    names = {str(p.relative_to(run)) for p in run.rglob("*") if p.is_file()}
    media = {
        "start",
        "end",
        "parts_start",
        "parts_end",
        "states",
        "compare",
        *(f"parts_t{t:03d}" for t in (0, 25, 50, 75, 100)),
    }
    want = {
        "twin.json",
        "cameras.json",
        *(f"splats/{s}.ply" for s in ("canonical", "start", "end")),
        *(f"media/{m}.png" for m in media),
    }
    assert names == want
    assert len(load_twin(run).gaussians) == len(toy_twin().gaussians)


def test_posed_splats_are_the_states(run):
    from p2gs.gaussians.splat_ply import read_splat_ply

    twin = object_to_input(toy_twin())
    for name, t in (("start", 0.0), ("end", 1.0)):
        g, ids = read_splat_ply(run / "splats" / f"{name}.ply")
        assert torch.allclose(g.means, pose(twin, t).means, atol=1e-5) and torch.equal(ids, twin.part_ids)


def test_the_chosen_view_looks_at_the_moving_front():
    """Door and drawer are on the cabinet's -y side; views from behind see neither."""
    twin = object_to_input(toy_twin())
    cameras = ring(8)
    assert cameras[best_camera(twin, cameras)].position[1] < -0.5
    assert orbit(twin, 8)[best_camera(twin, orbit(twin, 8))].position[1] < -0.5


def test_nearest_point_wins_in_labels():
    camera = ring(1)[0]
    toward = camera.position / camera.position.norm()
    means = torch.stack([0.2 * toward, -0.2 * toward])
    assert set(np.unique(point_labels(means, torch.tensor([3, 5]), camera))) == {-1, 3}
    assert set(np.unique(point_labels(means.flip(0), torch.tensor([3, 5]), camera))) == {-1, 5}


def test_orbit_has_the_whole_object_in_the_picture():
    twin = object_to_input(toy_twin())
    corners = torch.cartesian_prod(*bounds(twin).T).float()
    for camera in orbit(twin, 6):
        p = corners @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        uv = (p @ camera.K.T)[:, :2] / p[:, 2:]
        assert (p[:, 2] > 0).all() and (uv > 0).all() and (uv < 400).all()


def test_cameras_json_round_trip(run):
    want = scene_cameras(toy_scene(SIM, n=6, size=96))
    got = read_cameras(run / "cameras.json")
    assert [(c.name, c.state, c.split) for c in got] == [(c.name, c.state, c.split) for c in want]
    for a, b in zip(got, want, strict=True):
        assert torch.allclose(a.camera.viewmat, b.camera.viewmat, atol=1e-6) and torch.allclose(a.camera.K, b.camera.K)
    assert read_cameras(run / "nothing.json") == []


def test_framing_keeps_the_object_and_its_pixels():
    twin = object_to_input(toy_twin())
    camera = ring(8, size=96)[5]
    near, (x, y, w, h) = framed(twin, camera, 128)
    assert max(near.width, near.height) == 128 and w < 96
    point = torch.tensor([0.1, -0.2, 0.3])

    def pixel(c):
        p = c.viewmat[:3, :3] @ point + c.viewmat[:3, 3]
        return (c.K @ p)[:2] / p[2]

    want = (pixel(camera) - torch.tensor([x, y])) * torch.tensor([near.width / w, near.height / h])
    assert torch.allclose(pixel(near), want, atol=1e-3)


def test_part_colours_and_joints_are_in_the_picture():
    twin = object_to_input(toy_twin())
    camera = ring(8, size=128)[best_camera(twin, ring(8))]
    plain = render_parts(twin, camera, 0.0, joints=False).astype(float) / 255
    marked = render_parts(twin, camera, 0.0).astype(float) / 255
    for k in (1, 2):  # hue of the part's colour, whatever its shade
        hue = np.array(part_colour(k)) / np.linalg.norm(part_colour(k))
        assert ((plain @ hue) / np.linalg.norm(plain, axis=-1) > 0.995).mean() > 0.01
    assert (render_plain(twin, camera, 0.0) != render_plain(twin, camera, 1.0)).any()
    changed = np.abs(marked - plain).max(-1) > 0.1
    line = joint_strokes(twin, 1, 0.0, 1.5)[0][0]
    p = line @ camera.viewmat[:3, :3].double().numpy().T + camera.viewmat[:3, 3].double().numpy()
    uv = (p @ camera.K.double().numpy().T)[:, :2] / p[:, 2:]
    on_axis = changed[uv[:, 1].astype(int).clip(0, 127), uv[:, 0].astype(int).clip(0, 127)]
    assert on_axis.mean() > 0.5 and changed.mean() < 0.2


def test_joint_strokes_tell_the_joint():
    twin = object_to_input(toy_twin())
    (axis, _), (arc, arrow) = joint_strokes(twin, 1, 0.0, 1.5)
    assert np.allclose(axis[:, :2], [-0.49, -0.43]) and axis[-1, 2] > axis[0, 2] and arrow
    radius = np.linalg.norm(arc[:, :2] - [-0.49, -0.43], axis=1)
    assert np.allclose(radius, radius[0]) and arc[-1, 1] < arc[0, 1]  # opens towards -y
    ((path, arrow),) = joint_strokes(twin, 2, 0.0, 1.5)
    assert arrow and np.allclose(path[-1] - path[0], [0, -0.4, 0], atol=1e-6)
    assert path[0, 1] <= twin.gaussians.means[twin.part_ids == 2, 1].min() + 1e-4  # starts at the drawer's face


def test_part_coloured_has_no_view_dependence():
    twin = toy_twin(sh_degree=2)
    painted = part_coloured(twin.gaussians, twin.part_ids)
    assert painted.sh.shape[1:] == (1, 3) and painted.means is twin.gaussians.means


def test_compare_puts_the_photograph_of_the_state_first(run):
    """The first cell of each row is that state's photograph: it equals the twin's render beside it, and the rows
    differ."""
    image = read(run / "media" / "compare.png")
    cell = (image.shape[1] - 12) // 3
    row = 26 + 512
    for r in (0, 1):
        y = 26 + r * (image.shape[0] - 36) // 2
        block = image[y + 40 : y + row - 200]
        photo, twin = block[:, :cell], block[:, cell + 6 : 2 * cell + 6]
        assert np.abs(photo - twin).mean() < 0.03


def test_render_states_writes_any_time(run, tmp_path):
    files = render_states(run, [-0.2, 0.5], tmp_path, size=64)
    assert {f.name for f in files} == {"t-0.200.png", "parts_t-0.200.png", "t0.500.png", "parts_t0.500.png"}
    assert max(read(files[0]).shape[:2]) == 64
    with pytest.raises(UserError, match="no finished run"):
        render_states(tmp_path, [0.0])


def test_gifs_can_be_opened(tmp_path):
    from PIL import Image

    from p2gs.export.pages.video import write_gif

    ramp = np.tile(np.linspace(0, 255, 64).astype(np.uint8)[None, :, None], (32, 1, 3))
    frames = [np.roll(ramp, 4 * i, axis=1) for i in range(8)]
    gif = Image.open(write_gif(tmp_path / "a.gif", frames))
    assert gif.n_frames == 4 and gif.size == (64, 32)


def test_h264_where_imageio_ffmpeg_is_there(tmp_path):
    """Browsers and slides take H.264 with 4:2:0 chroma and nothing else."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg is not installed (pip install p2gs[video])")
    from p2gs.export.pages.video import write_video

    ramp = np.tile(np.linspace(0, 255, 64).astype(np.uint8)[None, :, None], (32, 1, 3))
    (path,) = write_video(tmp_path, [np.roll(ramp, 4 * i, axis=1) for i in range(24)])
    reader = ffmpeg.read_frames(str(path), pix_fmt="rgb24")
    about = next(reader)
    frames = [np.frombuffer(f, np.uint8).reshape(32, 64, 3) for f in reader]
    assert (
        path.suffix == ".mp4"
        and about["codec"] == "h264"
        and about["pix_fmt"].startswith("yuv420p")
        and len(frames) == 24
    )
    assert np.abs(frames[5].astype(int) - np.roll(ramp, 20, axis=1)).mean() < 8


def test_gif_and_frames_where_it_is_not(tmp_path, monkeypatch):
    import sys

    import cv2
    from PIL import Image

    from p2gs.export.pages.video import write_video

    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    frames = [np.full((32, 64, 3), 10 * i, np.uint8) for i in range(6)]
    gif, folder = write_video(tmp_path, frames)
    assert Image.open(gif).n_frames == 3
    stored = [cv2.imread(str(p)) for p in sorted(folder.glob("*.png"))]
    assert len(stored) == 6 and all((a == b).all() for a, b in zip(stored, frames, strict=True))


def test_pictures_are_drawn_with_the_runs_rasterizer(run, tmp_path):
    """A rasterizer of the user's own, named in the run's config, draws every picture of predict."""
    import shutil

    from p2gs.gaussians.paint import RASTERIZER, rasterizer_of
    from p2gs.render import RASTERIZERS, find_rasterizer

    calls = []
    if "counting" not in RASTERIZERS:

        @RASTERIZERS.register("counting")
        def counting(inputs):
            calls.append(inputs.width)
            return find_rasterizer("torch_ref")(inputs)

    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    (folder / "config.yaml").write_text("rasterizer: counting\n")
    render_states(folder, [0.5], size=24)
    assert calls and RASTERIZER.get() == "auto"
    with rasterizer_of(run) as name:  # no config there
        assert name == "auto"
    (folder / "config.yaml").write_text("rasterizer: nothing_of_that_name\n")
    with pytest.raises(UserError, match="unknown rasterizer"):
        render_states(folder, [0.5], size=24)
