"""docs/results.md lists what is really written: the keys of twin.json and metrics.json, the files of the folder."""

import json
import re

import pytest
import torch
from docs_pages import REPOSITORY, blocks
from toy import joint_prismatic, joint_revolute

from p2gs.types import ArticulatedObject, GaussianTensors, Part

PAGE = REPOSITORY / "docs" / "results.md"


def documented(title: str) -> dict:
    (block,) = [b for b in blocks(PAGE) if b.title == title]
    return json.loads(block.text)


def shape(value):
    """Keys of a JSON value, the items of lists made one."""
    if isinstance(value, dict):
        return {k: shape(v) for k, v in value.items()}
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return [shape({k: v for item in value for k, v in item.items()})]
    return None


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The demo cabinet's joints on a few Gaussians at the parts' places, boxes as meshes; its scene with depth and
    ground truth."""
    import numpy as np
    import trimesh

    from p2gs.config.run import load_config
    from p2gs.data.generated.generate import synthesize
    from p2gs.export.run_folder import write_twin
    from p2gs.ops.mesh import Mesh
    from p2gs.surface.mesh import write_mesh

    folder = tmp_path_factory.mktemp("results")
    scene = synthesize(folder / "scene", kind="demo", size=48, train_views=6, test_views=2)
    gen = torch.Generator().manual_seed(0)
    n = 90
    g = GaussianTensors(
        torch.rand(n, 3, generator=gen) - 0.5,
        torch.ones(n, 4),
        torch.full((n, 3), -2.5),
        torch.full((n,), 3.0),
        torch.rand(n, 1, 3, generator=gen),
    )
    joints = joint_revolute([0, 0, 1], [0.4, 0, 0], 60.0), joint_prismatic([0, -1, 0], [0, 0, 0], 0.3)
    obj = ArticulatedObject(g, torch.arange(n) % 3, [Part(0), Part(1, joints[0]), Part(2, joints[1])], 0.5)
    run = folder / "run"
    cfg = load_config(["preset/cpu.yaml", "data/artgs.yaml"], ["--data.root", str(scene)])
    write_twin(obj, run, cfg.data.raw_scene())
    (run / "config.yaml").write_text(f"data: {{format: artgs, root: {scene}}}\n")
    box = trimesh.creation.box((0.4, 0.4, 0.4))
    for state in ("start", "end"):
        (run / "meshes" / state).mkdir(parents=True)
        for k in range(3):
            mesh = Mesh(np.asarray(box.vertices), np.asarray(box.faces), np.zeros((len(box.vertices), 3), np.uint8))
            write_mesh(run / "meshes" / state / f"part_{k}.ply", mesh)
    return run


def test_twin_json(run):
    made, told = json.loads((run / "twin.json").read_text()), documented("twin.json")
    assert shape(made) == shape(told) and made["format"] == told["format"]
    assert [set(p) for p in made["parts"][:2]] == [set(p) for p in told["parts"]]


def test_metrics_json(run):
    from p2gs.scores.evaluate import evaluate_run

    made, told = evaluate_run(run), documented("metrics.json")
    assert made["joints"]["failures"] < 2, "one joint has to match for its errors to have keys"
    assert shape(made) == shape(told) and made["format"] == told["format"]


def test_files(run):
    """What a fit leaves before meshes and exports is listed, and every listed format exists."""
    from p2gs.export.formats import EXPORTERS

    listed = set(re.findall(r"`([\w./{},]+)`", PAGE.read_text().split("## twin.json")[0]))
    for path in run.iterdir():
        assert {path.name, path.name + "/"} & {name.split("/")[0] + ("/" if "/" in name else "") for name in listed}, (
            path.name
        )
    for path in (run / "splats").iterdir():
        assert {path.name, f"splats/{path.name}"} & listed
    assert set(EXPORTERS) == {"urdf", "mjcf", "glb", "usd", "ply", "obj", "splats", "spz"}


def test_its_python(run, monkeypatch, capsys):
    (block,) = [b for b in blocks(PAGE) if b.kind == "python"]
    names = {}
    exec(block.text.replace('"runs/my_scene"', "run"), {"run": run}, names)
    assert (
        capsys.readouterr().out.splitlines() == ["0 static", "1 revolute 60", "2 prismatic 0.3"]
        and len(names["half_open"]) == 90
    )
