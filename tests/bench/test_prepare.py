"""p2gs data prepare: what a downloaded tree has of the benchmarks."""

import shutil

import pytest

from p2gs.app import run
from p2gs.data.objects import Location, find_objects, pick_objects
from p2gs.data.prepare import prepare, prepare_lines
from p2gs.types import UserError


@pytest.fixture
def tree(tmp_path, scenes, write_scene):
    """A tree that has blade_103706 in the PARIS layout (whole), table_25493 without cameras, and oven_101908 with wrong
    joints."""
    for part in ("load", "data"):
        inner = scenes / "paris" / "blade" / part
        target = tmp_path / "paris" / part / "sapien" / "103706"
        shutil.copytree(inner, target, ignore=shutil.ignore_patterns("00[1-9]*.png"), copy_function=shutil.copyfile)
    write_scene(tmp_path / "artgs" / "sapien" / "table_25493", ["translate"] * 3)
    write_scene(tmp_path / "artgs" / "sapien" / "oven_101908", ["rotate", "rotate", "translate"])
    return tmp_path


def test_names():
    assert [o.id for o in pick_objects(["dta_multi", "blade_103706", "fridge_10489"])] == [
        "fridge_10489",
        "storage_47254",
        "blade_103706",
    ]
    assert len(pick_objects(["all"])) == 19
    table = pick_objects(["table_31249"])[0]
    assert (table.parts, table.joints) == (
        5,
        ("prismatic", "revolute", "prismatic", "revolute"),
    ) and table.column == "Table (5 parts)"
    with pytest.raises(UserError, match="no benchmark or object 'blade_103705' \\(did you mean 'blade_103706'"):
        pick_objects(["blade_103705"])


def test_objects_are_found_by_their_folder_or_by_their_source(tree, write_scene):
    found = find_objects(tree, pick_objects(["all"]))
    assert found == {
        "blade_103706": Location(tree / "paris", "paris", "sapien/103706"),
        "table_25493": Location(tree / "artgs" / "sapien" / "table_25493", "artgs"),
        "oven_101908": Location(tree / "artgs" / "sapien" / "oven_101908", "artgs"),
    }
    write_scene(tree / "dta" / "blade_103706", ["translate"])  # again, in a layout that has depth
    assert find_objects(tree, pick_objects(["blade_103706"]))["blade_103706"].format == "artgs"


def test_what_is_missing_is_said(tree, capsys):
    found = {p.object.id: p for p in prepare(tree, ["blade_103706", "artgs_multi"])}
    oven = " ".join(found["oven_101908"].problems)
    assert "has joints revolute, revolute, prismatic, the list says revolute, revolute, revolute" in oven
    assert "lacks the mesh of the whole, the static part, the moving parts" in oven
    assert any("transforms_train_end.json" in text for text in found["table_25493"].problems)
    # most of its images were not copied
    assert found["storage_45503"].where is None and not found["blade_103706"].ready
    text = "\n".join(prepare_lines(list(found.values())))
    assert "0 of 6 objects are ready; not there: table_31249, storage_45503, storage_47648" in text
    assert "more problems (p2gs data check" in text
    assert run(["data", "prepare", str(tree), "--objects", "storage_45503"]) == 2
    assert "storage_45503  missing     4 parts (3 revolute)" in capsys.readouterr().out


def test_a_whole_object_is_ready(scenes, tmp_path):
    """The blade among the test scenes, under the benchmark's name."""
    (tmp_path / "load" / "sapien" / "103706").mkdir(parents=True)
    (tmp_path / "data" / "sapien").mkdir(parents=True)
    for state in ("start", "end"):
        (tmp_path / "load" / "sapien" / "103706" / state).symlink_to(scenes / "paris" / "blade" / "load" / state)
    (tmp_path / "data" / "sapien" / "103706").symlink_to(scenes / "paris" / "blade" / "data")
    (found,) = prepare(tmp_path, ["blade_103706"])
    assert found.ready, found.problems
    assert found.summary == "paris layout, 64 train (start), 64 train (end), 10 test (start), 10 test (end), depth in 0"
    with pytest.raises(UserError, match="no such folder"):
        prepare(tmp_path / "nowhere")
