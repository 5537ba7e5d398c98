"""What a rerun finds changed: options, a mask, code; and what it says."""

import os
from functools import partial

import cv2
import pytest

from p2gs.config.run import load_config
from p2gs.data.base import TwoStateData
from p2gs.runtime.code import CodeReader
from p2gs.runtime.keys import changes, flat, scene_files
from p2gs.runtime.pipeline import Pipeline

TINY = """
include: [preset/smoke.yaml]
data: {{format: artgs, root: {root}, depth: never}}
phases: {{single_state: {{steps: 2, initial_gaussians: 300, min_visible: 0, levels: [24], level_starts: [0.0]}}}}
callbacks: {{checkpoint: null, scalars: null, previews: null, evaluation: null, families: null, progress: null}}
"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    from p2gs.data.generated.generate import synthesize

    return synthesize(tmp_path_factory.mktemp("keys") / "scene", 0, "demo", 24, 3, 1)


@pytest.fixture
def pipeline(scene, tmp_path):
    """``pipeline("--option", "value")``: of the same run folder each time."""
    (tmp_path / "tiny.yaml").write_text(TINY.format(root=scene))

    def make(*words, **options) -> Pipeline:
        words = ["--run", str(tmp_path / "run"), "--device", "cpu", "--threads", "1", *words]
        return Pipeline(load_config([str(tmp_path / "tiny.yaml")], words), **options)

    return make


def lines(capsys) -> list[str]:
    return capsys.readouterr().out.splitlines()


def test_changes_are_told_in_words():
    old = flat("phases", {"sharpen": {"steps": 600, "rates": {}}}) | {
        "file start/0.png": "a",
        "code of p2gs.x": "1",
        "gone": 3,
    }
    new = flat("phases", {"sharpen": {"steps": 20, "rates": {}}}) | {
        "file start/0.png": "b",
        "code of p2gs.x": "2",
        "file new.png": "c",
    }
    said = changes(old, new)
    assert said == (
        "phases.sharpen.steps was 600, is 20; the scene's file start/0.png changed; the code of p2gs.x changed; and "
        "2 more"
    )
    assert changes(old, old) == "" and changes({"a": None}, {"a": None}) == ""


def test_an_edited_mask_makes_the_reconstruction_again(pipeline, scene, capsys):
    pipeline().run("single_state")
    lines(capsys)
    pipeline().run("registration")
    assert "single_state_0: done before, unchanged" in lines(capsys)
    image = sorted((scene / "start" / "train" / "rgba").glob("*.png"))[0]
    old, before = image.read_bytes(), image.stat()
    pixels = cv2.imread(str(image), cv2.IMREAD_UNCHANGED)
    pixels[:2, :2, 3] = 255
    cv2.imwrite(str(image), pixels)
    try:
        again = pipeline()
        _ = again.scene
        assert again.done("single_state_0") is None
        (said,) = lines(capsys)
        assert said == f"single_state_0: runs again: the scene's file {image.relative_to(scene).as_posix()} changed"
        kept = pipeline(keep_stale=True)
        _ = kept.scene
        assert kept.done("single_state_0") is not None
        assert lines(capsys)[0].startswith("single_state_0: kept, though the scene's file")
    finally:
        image.write_bytes(old)
        os.utime(image, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert pipeline_is_done(pipeline())


def pipeline_is_done(again: Pipeline) -> bool:
    _ = again.scene
    return again.done("single_state_0") is not None


def test_a_file_that_is_not_the_scenes_changes_nothing(pipeline, scene):
    def key():
        one = pipeline()
        _ = one.scene
        return one.keys.key("single_state")

    before = key()
    (scene / "notes.txt").write_text("a remark")
    next(scene.rglob("trans.json")).touch()  # ground truth decides nothing
    assert key() == before


def test_options_and_code_of_a_stage_and_of_those_before_it(pipeline, monkeypatch):
    def keys(*words):
        one = pipeline(*words)
        _ = one.scene
        return {name: one.keys.key(name) for name in one.order}

    before = keys()

    def differ(other) -> list[str]:
        return [name for name in before if before[name] != other[name]]

    assert differ(keys()) == []
    assert differ(keys("--phases.sharpen.steps", "7")) == [
        "sharpen",
        "discovery",
        "canonical_fusion",
        "articulation",
        "finish",
    ]
    assert differ(keys("--num_parts", "3")) == ["discovery", "canonical_fusion", "articulation", "finish"]
    assert differ(keys("--phases.discovery.rounds", "1")) == ["discovery", "canonical_fusion", "articulation", "finish"]
    assert differ(keys("--phases.registration.reach", "0.1"))[:3] == ["registration", "sharpen", "discovery"]
    assert differ(keys("--callbacks.previews.every", "7")) == []
    real = CodeReader.code_of
    edited = partial(changed_code, real, "p2gs.models.finish")
    monkeypatch.setattr(CodeReader, "code_of", lambda self, modules: edited(self, modules))
    assert differ(keys()) == ["finish"]


def changed_code(real, module, reader, modules) -> dict:
    return {name: code + ("!" if name == module else "") for name, code in real(reader, modules).items()}


def test_hashes_of_files_are_kept_by_size_and_time(tmp_path):
    file, cache = tmp_path / "a.png", tmp_path / "cache.json"
    file.write_bytes(b"one")
    first = scene_files([file], tmp_path, cache)
    assert set(first) == {"a.png"} and cache.is_file()
    file.write_bytes(b"two")
    os.utime(file, ns=(1, 1))
    assert scene_files([file], tmp_path, cache) != first
    file.write_bytes(b"one")
    assert scene_files([file], tmp_path, cache) == first
    cache.write_text("damaged")
    assert scene_files([file, tmp_path / "missing.png"], tmp_path, cache) == first


def test_a_dataset_that_reads_for_itself_counts_all_below_its_root(tmp_path):
    class Own(TwoStateData):
        def read(self):
            raise AssertionError("not needed")

    (tmp_path / "deep").mkdir()
    for name in ("recipe.json", "deep/a.bin"):
        (tmp_path / name).write_text(name)
    assert Own(str(tmp_path)).files() == [tmp_path / "deep/a.bin", tmp_path / "recipe.json"]
