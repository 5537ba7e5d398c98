"""Merging, switching off, overrides, includes, formats, saving."""

from types import SimpleNamespace

import pytest
import yaml

from p2gs.config.run import load_config, save_config
from p2gs.types import UserError

BASE = """
callbacks: {progress: {every: 3}}
phases:
  first:
    steps: 50
    rates: {means: 1e-4}
    losses: {render: {ssim: 0.5}}
  second:
    losses:
      render: {}
      part: {weight: 0.1, temperature: 3}
      contact: {weight: 0.5}
"""


@pytest.fixture
def base(fakes, write):
    return write("base.yaml", BASE)


def test_defaults_and_types(base):
    cfg = load_config([base])
    assert cfg.seed == 0 and cfg.num_parts == "auto" and cfg.device == "auto"
    first = cfg.phases["first"].config
    assert first.steps == 50 and first.rates.means == 1e-4 and first.rates.quats == 2e-3 and first.extra is None
    assert list(cfg.phases["second"].losses) == ["render", "part", "contact"]
    assert cfg.phases["second"].losses["part"].temperature == 3.0
    assert cfg.phases["first"].losses["render"].weight == 1.0


def test_a_loss_that_is_not_mentioned_is_off(base):
    assert list(load_config([base]).phases["first"].losses) == ["render"]


def test_overlay_merges_deeply_and_null_switches_off(base, write):
    overlay = write("over.yaml", "phases: {second: {losses: {part: {weight: 9}, contact: null}}}")
    losses = load_config([base, overlay]).phases["second"].losses
    assert list(losses) == ["render", "part"]
    assert losses["part"].weight == 9 and losses["part"].temperature == 3


def test_command_line_overrides_one_field_and_switches_off(base):
    words = [
        "--phases.second.losses.part.weight",
        "0.3",
        "--phases.second.losses.contact",
        "null",
        "--phases.first.levels=[50]",
    ]
    cfg = load_config([base], words)
    losses = cfg.phases["second"].losses
    assert losses["part"].weight == 0.3 and losses["part"].temperature == 3 and "contact" not in losses
    assert cfg.phases["first"].config.levels == [50]


def test_command_line_switches_on(base):
    cfg = load_config([base], ["--phases.first.losses.contact.weight", "2", "--phases.first.extra", "{}"])
    assert cfg.phases["first"].losses["contact"].weight == 2
    assert cfg.phases["first"].config.extra.means == 1e-3


def test_off_then_on_again_starts_from_defaults(base, write):
    off = write("off.yaml", "phases: {second: {losses: {part: null}}}")
    on = write("on.yaml", "phases: {second: {losses: {part: {weight: 2}}}}")
    part = load_config([base, off, on]).phases["second"].losses["part"]
    assert part.weight == 2 and part.temperature == 1.0


def test_a_whole_phase_is_switched_off(base):
    assert list(load_config([base], ["--phases.first", "null"]).phases) == ["second"]


def test_a_stage_that_is_not_trained_has_no_losses_and_no_callbacks(base):
    cfg = load_config([base], ["--phases.untrained.means", "3"])
    stage = cfg.phases["untrained"]
    assert stage.config.means == 3 and stage.losses == {} and stage.callbacks == {}
    assert cfg.section("untrained") == {"means": 3.0, "quats": 2e-3}
    with pytest.raises(UserError, match="no option 'phases.untrained.losses'"):
        load_config([base], ["--phases.untrained.losses.render", "{}"])


def test_callbacks_of_all_phases_and_of_one(base):
    cfg = load_config([base], ["--phases.second.callbacks", "{progress: {style: dots}, count: {top: 2}}"])
    assert list(cfg.phases["first"].callbacks) == ["progress"]
    second = cfg.phases["second"].callbacks
    assert second["progress"].every == 3 and second["progress"].style == "dots" and second["count"].top == 2
    assert list(load_config([base], ["--phases.second.callbacks.progress", "null"]).phases["second"].callbacks) == []
    assert second["progress"] is not cfg.phases["first"].callbacks["progress"]
    again = cfg.phases["second"].new_callbacks()
    assert again["count"] is not second["count"] and again["count"].top == 2


def test_overlay_still_reaches_a_phase_with_callbacks_of_its_own(base, write, tmp_path):
    own = write("own.yaml", "phases: {second: {callbacks: {progress: {style: dots}}}}")
    cfg = load_config([base, own])
    save_config(cfg, tmp_path / "saved.yaml")
    again = load_config([tmp_path / "saved.yaml"], ["--callbacks.progress.every", "7"])
    assert (
        again.phases["second"].callbacks["progress"].every == 7
        and again.phases["second"].callbacks["progress"].style == "dots"
    )


def test_include_is_laid_below(base, write):
    main = write("sub/main.yaml", "include: [../base.yaml]\nphases: {first: {steps: 7}}")
    cfg = load_config([main])
    assert cfg.phases["first"].config.steps == 7 and cfg.phases["first"].config.rates.means == 1e-4
    loop = write("loop.yaml", "include: loop.yaml")
    with pytest.raises(UserError, match="includes itself"):
        load_config([loop])


def test_seed_like_options_come_from_both_sides(base, write):
    cfg = load_config([base, write("s.yaml", "seed: 3\nnum_parts: 4")], ["--num_parts", "auto", "--run", "2024"])
    assert cfg.seed == 3 and cfg.num_parts == "auto" and cfg.run == "2024"


def test_data_is_built_when_asked_for(base, tmp_path):
    cfg = load_config([base], ["--data.root", str(tmp_path / "box"), "--data.format", "folder", "--data.views", "4"])
    assert cfg.data.views == 4 and cfg.data is cfg.data
    assert cfg.scene_name == "box" and str(cfg.run_dir) == "runs/box"


def test_data_without_root_or_format_is_told_when_needed(base):
    cfg = load_config([base], ["--data.format", "folder"])
    assert cfg.to_dict()["data"]["root"] is None
    with pytest.raises(UserError, match=r"data\.root is not given \(--data\.root"):
        _ = cfg.data
    with pytest.raises(UserError, match=r"data\.format is not given.*folder, made"):
        _ = load_config([base]).data


def test_format_is_found_from_the_folder(base, fakes, tmp_path, monkeypatch):
    (tmp_path / "box").mkdir()
    (tmp_path / "box" / "note.txt").touch()
    with pytest.raises(
        UserError, match=r"data\.format is not given, and .*box looks like none of the layouts artgs, dta, paris"
    ):
        load_config([base], ["--data.root", str(tmp_path / "box")])
    with pytest.raises(UserError, match=r"data\.root: the folder .*nowhere is not there"):
        load_config([base], ["--data.root", str(tmp_path / "nowhere")])
    monkeypatch.setattr(
        "p2gs.data.layouts.LAYOUTS", {"folder": SimpleNamespace(detect=lambda root: (root / "note.txt").is_file())}
    )
    cfg = load_config([base], ["--data.root", str(tmp_path / "box"), "--data.views", "4"])
    assert cfg.data_options["format"] == "folder" and cfg.data.views == 4


def test_changing_the_format_drops_what_only_the_old_one_knew(base, write):
    made = write("made.yaml", "data: {format: made, kind: door, views: 9}")
    cfg = load_config([base, made], ["--data.format", "folder", "--data.root", "x"])
    assert cfg.data_options == {"format": "folder", "root": "x", "downscale": 1.0, "views": 9}
    with pytest.raises(UserError, match="no option 'data.kind'"):  # but not what is given along with the new one
        load_config([base, made], ["--data.format", "folder", "--data.kind", "door"])


def test_section_for_hashing(base):
    def section(*overrides):
        return load_config([base], list(overrides)).section("second")

    assert (
        section()
        == section("--callbacks.progress.every", "99")
        == section("--phases.first.steps", "1")
        == section("--seed", "5")
    )
    assert section() != section("--phases.second.losses.part.weight", "0.2")
    assert section() != section("--phases.second.callbacks.count", "{}")  # count changes the result
    assert section() != section("--phases.second.losses.contact", "null")
    assert load_config([base]).section("seed") == 0


def test_saved_config_reads_back_the_same(base, tmp_path):
    cfg = load_config(
        [base], ["--data.format", "folder", "--data.root", "x", "--phases.second.losses.contact", "null", "--seed", "8"]
    )
    save_config(cfg, tmp_path / "run" / "config.yaml")
    stored = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    assert set(stored["p2gs"]) == {"version", "git", "command"} and stored["seed"] == 8
    again = load_config([tmp_path / "run" / "config.yaml"])
    assert again.to_dict() == cfg.to_dict() and again.section("second") == cfg.section("second")
    assert not list((tmp_path / "run").glob("*.part"))


def test_our_own_configs_are_found_from_anywhere(fakes, tmp_path, monkeypatch):
    from p2gs.config.files import find_config

    monkeypatch.chdir(tmp_path)
    assert find_config("base.yaml") == find_config("configs/base.yaml") == find_config("base")
    assert find_config("preset/cpu.yaml").name == "cpu.yaml"
    with pytest.raises(UserError, match="did you mean 'preset/cpu.yaml'"):
        find_config("preset/cpuu.yaml")


def test_a_config_that_another_version_wrote_is_read_without_the_options_that_are_no_more(base, tmp_path, capsys):
    save_config(load_config([base]), tmp_path / "config.yaml")
    tree = yaml.safe_load((tmp_path / "config.yaml").read_text())
    tree["phases"]["first"] |= {"gone": 3, "rates": {**tree["phases"]["first"]["rates"], "means_of_old": 1.0}}
    written = tmp_path / "older.yaml"
    written.write_text(yaml.safe_dump(tree))
    assert load_config([written]).to_dict() == load_config([base]).to_dict()
    told = capsys.readouterr().err
    assert told.count("note:") == 1 and "phases.first.gone, phases.first.rates.means_of_old" in told
    load_config([written])
    assert not capsys.readouterr().err  # once a process
    del tree["p2gs"]  # nobody but p2gs writes that section: here someone mistyped
    written.write_text(yaml.safe_dump(tree))
    with pytest.raises(UserError, match="no option 'phases.first.gone'"):
        load_config([written])
