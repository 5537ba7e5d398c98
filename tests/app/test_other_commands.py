"""test, predict, export, view, data: from words to files, on a twin written by hand and a scene generated small."""

import json
import sys

import pytest
import torch

from p2gs.cli import main
from p2gs.types import ArticulatedObject, GaussianTensors, Joint, Part


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    """A run folder with two clouds of Gaussians, the second sliding 0.5 along x; and its object."""
    from p2gs.gaussians.splat_ply import write_splat_ply
    from p2gs.gaussians.twin_json import write_twin_json

    gen = torch.Generator().manual_seed(0)
    n = 60
    g = GaussianTensors(
        torch.rand(n, 3, generator=gen) - 0.5,
        torch.randn(n, 4, generator=gen),
        torch.full((n, 3), -2.5),
        torch.full((n,), 3.0),
        torch.rand(n, 4, 3, generator=gen),
    )
    T = torch.eye(4, dtype=torch.float64)
    T[0, 3] = 0.5
    ids = torch.arange(n) % 2
    joint = Joint("prismatic", torch.tensor([1.0, 0, 0]), torch.zeros(3), 0.5, (0.0, 0.5), T)
    obj = ArticulatedObject(g, ids, [Part(0), Part(1, joint)], 0.5)
    run = tmp_path_factory.mktemp("runs") / "twin"
    (run / "splats").mkdir(parents=True)
    write_splat_ply(run / "splats" / "canonical.ply", g, ids)
    write_twin_json(obj, run / "twin.json")
    return run, obj


def failure(capsys, *words) -> str:
    assert main(list(words)) == 2
    out, err = capsys.readouterr()
    assert err.startswith("error: ") and err.count("\n") == 1
    return err


def test_predict_writes_a_picture_for_every_time(twin, tmp_path, capsys):
    import cv2

    run, _ = twin
    assert main(["predict", str(run), "--times", "0", "1.5", "--out", str(tmp_path / "p"), "--size", "48"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert sorted(p.name for p in (tmp_path / "p").iterdir()) == [
        "parts_t0.000.png",
        "parts_t1.500.png",
        "t0.000.png",
        "t1.500.png",
    ]
    assert len(printed) == 4 and max(cv2.imread(printed[0]).shape[:2]) == 48
    assert "at least 16 pixels" in failure(capsys, "predict", str(run), "--size", "3")


def test_test_needs_the_config_of_the_run(twin, capsys):
    assert "config.yaml is missing" in failure(capsys, "test", str(twin[0]))


def test_export_names_the_formats(twin, capsys):
    assert "unknown export format 'urfd' (did you mean 'urdf'?)" in failure(
        capsys, "export", str(twin[0]), "--format", "urfd"
    )
    assert "--scale: expected a positive number" in failure(capsys, "export", str(twin[0]), "--scale", "0")


def test_view_without_viser_says_what_to_install(twin, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert "pip install 'p2gs[viewer]'" in failure(capsys, "view", str(twin[0]))


def test_what_the_viewer_draws(twin):
    """Centres carried by a part's frame, and covariances, are those of the posed twin."""
    from types import SimpleNamespace

    from p2gs.export.pages.viewer import place, splat_arrays
    from p2gs.gaussians.pose import pose
    from p2gs.ops.so3 import quat_to_matrix

    _, obj = twin
    for part, t in ((0, 1.0), (1, 0.0), (1, 1.0)):
        arrays, frame = splat_arrays(obj, part), SimpleNamespace()
        place(frame, obj, part, t)
        R = quat_to_matrix(torch.tensor(frame.wxyz)).numpy()
        chosen = obj.part_ids == part
        assert abs(arrays["centers"] @ R.T + frame.position - pose(obj, t).means[chosen].numpy()).max() < 1e-6
        eigenvalues = torch.linalg.eigvalsh(torch.tensor(arrays["covariances"]))
        assert torch.allclose(eigenvalues, obj.gaussians.log_scales[chosen].exp() ** 2, rtol=1e-4)
        assert arrays["opacities"].shape == (30, 1) and 0 <= arrays["rgbs"].min() <= arrays["rgbs"].max() <= 1


def test_viewer_in_the_browser(twin):
    pytest.importorskip("viser", reason="viser is not installed (pip install p2gs[viewer])")
    from p2gs.export.pages.viewer import open_viewer

    server = open_viewer(twin[0], port=18080)
    try:
        frame = server.scene._handle_from_node_name["/part_1"]
        assert frame.position.tolist() == pytest.approx([-0.25, 0, 0])
    finally:
        server.stop()


def test_data_synth_then_check(tmp_path, capsys):
    scene = tmp_path / "scene"
    assert (
        main(
            [
                "data",
                "synth",
                str(scene),
                "--seed",
                "3",
                "--size",
                "48",
                "--views",
                "6",
                "--test_views",
                "2",
                "--kind",
                "demo",
            ]
        )
        == 0
    )
    assert "--data.root" in capsys.readouterr().out
    assert main(["data", "check", str(scene)]) == 0
    assert "can be trained on" in capsys.readouterr().out
    (scene / "start" / "train" / "rgba" / "0000.png").unlink()
    assert main(["data", "check", str(scene)]) == 2
    assert "0000.png" in capsys.readouterr().err
    assert "expected at least 1" in failure(capsys, "data", "synth", str(tmp_path / "x"), "--views", "0")
    assert main(["data", "check", str(tmp_path / "nowhere")]) == 2
    assert "scene folder is missing" in capsys.readouterr().err


def test_test_scores_a_run_and_prints_it(twin, tmp_path, capsys):
    """The hand-made twin against a generated scene: nonsense figures, but the whole way to metrics.json and the
    table."""
    import shutil

    run = tmp_path / "run"
    shutil.copytree(twin[0], run)
    scene = tmp_path / "scene"
    assert (
        main(["data", "synth", str(scene), "--size", "48", "--views", "6", "--test_views", "1", "--kind", "demo"]) == 0
    )
    (run / "config.yaml").write_text(f"data: {{format: artgs, root: {scene}}}\n")
    (run / "report.html").write_text("as the fit left it")
    capsys.readouterr()
    assert main(["test", str(run)]) == 0
    out = capsys.readouterr().out
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["num_parts"] == 2 and len(metrics["joints"]["joints"]) == 2 and metrics["joints"]["failures"] >= 1
    assert "axis angle" in out and "PSNR" in out and "metrics.json" in out
    assert "<h2>Scores</h2>" in (run / "report.html").read_text()
