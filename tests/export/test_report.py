"""The page about a run: what it says, that nothing in it comes from elsewhere, and, where there is a browser, that it
works."""

import base64
import http.server
import json
import queue
import re
import shutil
import subprocess
import threading

import numpy as np
import pytest
from toy import toy_scene, toy_twin

from p2gs.export.pages.report import chart, is_loss, write_report
from p2gs.export.pages.report_view import front
from p2gs.export.run_folder import complete_run, write_twin
from p2gs.surface.mesh import write_meshes
from p2gs.types import UserError

METRICS = {
    "views": {"start": {"split": "test", "count": 2, "psnr_white": 31.234, "ssim_white": 0.971}},
    "chamfer": {k: {"value": 1.5, "floor": 0.4} for k in ("static", "movable", "whole")},
    "joints": {
        "joints": [
            {
                "gt": 0,
                "pred": 0,
                "pred_type": "revolute",
                "errors": {"axis_angle": 0.123, "axis_position": 0.045, "motion": 0.067},
            },
            {"gt": 1, "pred": 1, "pred_type": "prismatic", "errors": None},
        ]
    },
    "missing": ["the scene has no <depth> maps"],
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cabinet")
    write_twin(toy_twin(), folder, toy_scene(n=8, size=96))
    write_meshes(folder, resolution=36)
    (folder / "logs" / "articulation").mkdir(parents=True)
    (folder / "logs" / "stages.json").write_text(
        json.dumps({"single_state_0": {"seconds": 12.5, "peak_memory_mib": 900}})
    )
    from torch.utils.tensorboard import SummaryWriter

    with SummaryWriter(folder / "logs" / "articulation") as log:
        for step in range(20):
            log.add_scalar("articulation/render", 1 / (step + 1), step)
    (folder / "metrics.json").write_text(json.dumps(METRICS))
    return folder


def test_the_page_tells_the_run_and_stands_alone(run):
    page = write_report(run).read_text()
    assert "3 parts, 2 of them moving" in page and "-70.0&deg;" in page and "0.400" in page
    assert "31.234" in page and "0.123&deg;" in page and '<td class="bad">F</td>' in page and "0.400" in page
    assert "12.5" in page and ">render</text>" in page and "no &lt;depth&gt; maps" in page
    assert page.count('<input type="range"') == 2 and page.count("data:image/png;base64,") == 2
    outside = re.findall(r'(?:src|href)="(?!data:)[^"]*"|https?://', page.replace("http://www.w3.org", ""))
    assert outside == []


def test_a_bare_run_has_a_page_too(tmp_path):
    write_twin(toy_twin(), tmp_path, toy_scene(n=2, size=16), media=False)
    page = write_report(tmp_path).read_text()
    assert "Parts and joints" in page and "canvas" not in page and "Scores" not in page and "Losses" not in page
    with pytest.raises(UserError, match="no finished run"):
        write_report(tmp_path / "none")


def test_complete_run_makes_the_whole_folder(tmp_path):
    write_twin(toy_twin(), tmp_path, toy_scene(n=6, size=48), media=False)
    said = []
    complete_run(tmp_path, ["glb"], log=said.append)
    assert [line.split(":")[0] for line in said] == ["meshes", "exports", "report"]
    for name in ("meshes/start/part_1.ply", "meshes/end/whole.ply", "twin.glb", "report.html"):
        assert (tmp_path / name).is_file(), name


def test_the_view_opens_on_the_moving_front():
    """The front is -y of the input, which is +z of the page's y-up world: turn near 0."""
    assert abs(front(toy_twin())) < 1.2


def test_chart_leaves_out_what_a_logarithm_cannot_show():
    svg = chart({"a": np.array([[0, 1.0], [10, 0.1], [20, 0.0], [30, np.nan]]), "b": np.array([[0, -1.0], [1, 0.0]])})
    assert svg.count('stroke="#') == 1 and ">a</text>" in svg and ">b</text>" not in svg and "10 steps" in svg
    assert chart({"b": np.array([[0, 0.0]])}) == ""
    assert (
        is_loss("articulation/render")
        and not is_loss("articulation/gaussians")
        and not is_loss("articulation/joint/1/motion")
    )


def chromium():
    """Path of a headless Chromium; the test is skipped where there is none."""
    names = ("chromium", "chromium-headless-shell", "chromium-browser", "google-chrome")
    browser = next(filter(None, map(shutil.which, names)), None)
    return browser or pytest.skip("no Chromium here")


def test_in_a_browser_the_slider_moves_the_part(run, tmp_path):
    """Headless Chromium: no error on the console, something drawn, and another picture with the joint at its end."""
    import cv2

    browser, page, shots = chromium(), write_report(run), []
    for state in ("1=0", "1=1"):
        shot = tmp_path / f"{state}.png"
        flags = [
            "--headless=new",
            "--no-sandbox",
            "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader",
            "--enable-logging=stderr",
        ]
        flags += [
            "--window-size=500,700",
            "--virtual-time-budget=2000",
            f"--user-data-dir={tmp_path / 'profile'}",
            f"--screenshot={shot}",
        ]
        done = subprocess.run([browser, *flags, f"file://{page}#{state}"], capture_output=True, text=True, timeout=90)
        said = [line for line in done.stderr.splitlines() if "CONSOLE" in line and "GL Driver Message" not in line]
        assert said == []
        shots.append(cv2.imread(str(shot)).astype(int))
    canvas = slice(100, 400)
    assert shots[0][canvas].std() > 5  # not an empty view
    assert (np.abs(shots[0] - shots[1])[canvas].max(-1) > 30).mean() > 0.01


WATCH = """<script>(function () {  // posts both canvases once the splats are there, and again with joint 1 at its end
  const views = ["view", "splats"].map((id) => document.getElementById(id));
  let before = "", moved = false;
  setInterval(() => {
    const shots = views.map((c) => c.toDataURL());
    const blank = document.createElement("canvas");
    [blank.width, blank.height] = [views[1].width, views[1].height];
    if (shots[1] === blank.toDataURL() || shots[1] === before) return;
    const still = shots[1] === window.last;  // sorting takes a moment
    window.last = shots[1];
    if (!still) return;
    before = shots[1];
    const loaded = performance.getEntriesByType("resource").map((r) => r.name);
    fetch("/", { method: "POST", body: JSON.stringify({ shots, loaded }) });
    if (moved) return;
    moved = true;
    const slider = document.querySelector("input[data-part='1']");
    slider.value = 1;
    slider.dispatchEvent(new Event("input"));
  }, 300);
})();</script>"""


@pytest.fixture
def watched(run, tmp_path):
    """What the page posts in a headless Chromium: pictures [H, W, 4] of the two canvases with joint 1 at its start and
    at its end, and what the page loaded."""
    browser, page = chromium(), (write_report(run).read_text() + WATCH).encode()
    posts: queue.Queue = queue.Queue()

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.end_headers()
            self.wfile.write(page)

        def do_POST(self):
            posts.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(204)
            self.end_headers()

        def log_message(self, *_):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    flags = [
        "--headless",
        "--no-sandbox",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--remote-debugging-port=0",
    ]
    flags += ["--window-size=500,700", f"--user-data-dir={tmp_path / 'profile'}"]
    address = f"http://127.0.0.1:{server.server_port}/"
    with subprocess.Popen([browser, *flags, address], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            yield address, [posts.get(timeout=60) for _ in range(2)]
        finally:
            process.terminate()
            server.shutdown()
            server.server_close()


def test_in_a_browser_the_splats_stand_where_the_mesh_stands_and_move_with_it(watched):
    import cv2

    address, posts = watched
    assert [n for post in posts for n in post["loaded"] if n.startswith("http") and not n.startswith(address)] == []
    drawn = []
    for post in posts:
        pictures = [np.frombuffer(base64.b64decode(shot.split(",")[1]), np.uint8) for shot in post["shots"]]
        mesh, splats = (cv2.imdecode(p, cv2.IMREAD_UNCHANGED)[..., 3] > 128 for p in pictures)
        assert (mesh & splats).sum() > 0.8 * (mesh | splats).sum()
        drawn.append(splats)
    assert (drawn[0] ^ drawn[1]).sum() > 0.02 * drawn[0].sum()  # the door


def test_a_stage_run_again_draws_one_curve(tmp_path):
    from torch.utils.tensorboard import SummaryWriter

    from p2gs.export.pages.report import read_scalars

    for sitting, steps in enumerate((range(0, 10), range(4, 8))):
        writer = SummaryWriter(str(tmp_path), filename_suffix=str(sitting))
        for step in steps:
            writer.add_scalar("loss/render", 10.0 * sitting + step, step, walltime=1000.0 * sitting + step)
        writer.close()
    assert read_scalars(tmp_path)["loss/render"].tolist() == [
        [0, 0],
        [1, 1],
        [2, 2],
        [3, 3],
        [4, 14],
        [5, 15],
        [6, 16],
        [7, 17],
    ]
