"""Files that lead out of their root: named before they are read, refused with --strict_paths."""

import json
import os
import shutil

import pytest

from p2gs.app import run
from p2gs.config.files import read_config
from p2gs.config.run import load_config
from p2gs.data.check import check_dataset
from p2gs.data.modules import DATASETS
from p2gs.types import UserError


def dots(root, away):
    return f"../{away.name}/there.png"


def absolute(root, away):
    return str(away / "there.png")


def link(root, away):
    os.symlink(away / "there.png", root / "start/train/rgba/link.png")
    return "start/train/rgba/link.png"


def linked_folder(root, away):
    os.symlink(away, root / "start/train/more")
    return "start/train/more/there.png"


@pytest.mark.parametrize("how", [dots, absolute, link, linked_folder])
def test_an_image_elsewhere_is_named_or_refused(copy_of, tmp_path, how, capsys):
    root, away = copy_of("artgs"), tmp_path / "away"
    away.mkdir()
    shutil.copy(root / "start/train/rgba/0003.png", away / "there.png")
    file = root / "transforms_train_start.json"
    meta = json.loads(file.read_text())
    meta["frames"][3]["file_path"] = how(root, away)
    file.write_text(json.dumps(meta))

    findings = check_dataset(root)
    named = [f.message for f in findings if "leads out of the scene's folder" in f.message]
    assert (
        len(named) == 1
        and str((away / "there.png").resolve()) in named[0]
        and not any(f.level == "error" for f in findings)
    )
    assert DATASETS["artgs"](root=str(root)).scene().views
    assert named[0] in capsys.readouterr().err

    errors = [f.message for f in check_dataset(root, strict_paths=True) if f.level == "error"]
    assert errors == [f"{named[0]}; refused, as strict_paths asks"]
    data = DATASETS["artgs"](root=str(root))
    data.strict_paths = True
    with pytest.raises(UserError, match="refused, as strict_paths asks"):
        data.scene()


def test_a_name_of_a_frame_may_lead_out(copy_of, tmp_path):
    root = copy_of("paris")
    shutil.copy(root / "load/start/train/0000.png", tmp_path / "there.png")
    file = root / "load/start/camera_train.json"
    cameras = json.loads(file.read_text())
    cameras["../../../../there"] = cameras.pop("0000")
    file.write_text(json.dumps(cameras))
    assert any(
        "there.png: leads out" in f.message and f.level == "error" for f in check_dataset(root, strict_paths=True)
    )


@pytest.mark.parametrize("name", ["cam_K.txt", "init_keyframes.yml", "mask/1_0002.png", "depth_filtered/0_0005.png"])
def test_a_linked_file_is_not_opened(copy_of, tmp_path, name):
    root = copy_of("dta")
    shutil.move(root / name, tmp_path / "elsewhere")
    os.symlink(tmp_path / "elsewhere", root / name)
    assert not [f for f in check_dataset(root) if f.level == "error"]
    assert any("leads out" in f.message for f in check_dataset(root, strict_paths=True) if f.level == "error")


def test_a_root_that_is_a_link_is_no_way_out(copy_of, tmp_path):
    os.symlink(copy_of("artgs"), tmp_path / "scene")
    assert not any("leads out" in f.message for f in check_dataset(tmp_path / "scene", strict_paths=True))


def test_an_include_elsewhere_is_named_or_refused(tmp_path, capsys):
    inner = tmp_path / "mine"
    inner.mkdir()
    (tmp_path / "other.yaml").write_text("seed: 5\n")
    (inner / "a.yaml").write_text("include: [preset/smoke.yaml, ../other.yaml]\n")
    assert load_config([str(inner / "a.yaml")]).seed == 5
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "include: leads out of" in said and str(tmp_path / "other.yaml") in said
    with pytest.raises(UserError, match="other.yaml; refused, as strict_paths asks"):
        read_config(str(inner / "a.yaml"), strict=True)
    (inner / "b.yaml").write_text("strict_paths: true\ninclude: ../other.yaml\n")
    with pytest.raises(UserError, match="refused"):
        load_config([str(inner / "b.yaml")])


def test_the_commands_take_the_option(copy_of, tmp_path, capsys):
    root = copy_of("artgs")
    shutil.move(root / "start/train/rgba/0001.png", tmp_path / "1.png")
    os.symlink(tmp_path / "1.png", root / "start/train/rgba/0001.png")
    assert run(["data", "check", str(root)]) == 0
    assert run(["data", "check", str(root), "--strict_paths"]) == 2
    capsys.readouterr()
    assert (
        run(
            [
                "fit",
                "-c",
                "preset/smoke.yaml",
                "--data.root",
                str(root),
                "--run",
                str(tmp_path / "run"),
                "--strict_paths",
            ]
        )
        == 2
    )
    assert "refused, as strict_paths asks" in capsys.readouterr().err
