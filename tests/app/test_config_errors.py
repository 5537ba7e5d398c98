"""Every mistake gets one sentence that names the place and the nearest right key."""

import pytest

from p2gs.config.run import load_config
from p2gs.types import UserError

MISTAKES = [
    (["--seeed", "1"], r"no option 'seeed' \(did you mean 'seed'\?\)"),
    (["--phases.secnd.steps", "1"], r"no option 'phases\.secnd' \(did you mean 'phases\.second'\?\)"),
    (
        ["--phases.second.losses.part.wieght", "1"],
        r"no option '.*part\.wieght' \(did you mean 'phases\.second\.losses\.part\.weight'\?\)",
    ),
    (["--phases.second.losses.prt", "null"], r"did you mean 'phases\.second\.losses\.part'"),
    (["--second.losses.part.weight", "1"], r"no option 'second' \(did you mean 'phases\.second'\?\)"),
    (["--temperature", "1"], r"did you mean 'phases\.(first|second)\.losses\.part\.temperature'"),
    (["--phases.first.rates.mean", "1"], r"did you mean 'phases\.first\.rates\.means'"),
    (["--data.rot", "x", "--data.format", "folder"], r"did you mean 'data\.root'"),
    (["--data.format", "foldr"], r"data\.format: there is no 'foldr' \(did you mean 'folder'\?\)"),
    (["--callbacks.progres", "{}"], r"did you mean 'callbacks\.progress'"),
    (["--phases.first.steps", "many"], r"phases\.first\.steps: expected a whole number, got 'many'"),
    (["--phases.first.init", "hull"], r"phases\.first\.init: expected one of auto, random, got 'hull'"),
    (
        ["--phases.first.rates", "null", "--phases.first.rates", "3"],
        r"phases\.first\.rates: expected options \(key: value\) or null, got '3'",
    ),
    (
        ["--phases.second.losses.part", "true"],
        r"phases\.second\.losses\.part: expected options \(key: value\) or null, got 'true'",
    ),
    (["--phases.second.losses.part.variant", "letter"], r"expected one of paper, sane"),
    (["--device", "gpu"], r"device: expected one of auto, cpu, cuda, got 'gpu'"),
    (["--num_parts", "some"], r"num_parts: expected a whole number or 'auto', got 'some'"),
    (["--num_parts", "1"], r"num_parts: expected at least 2"),
    (["--threads", "0"], r"threads: expected at least 1"),
    (["--seed"], r"--seed needs a value"),
    (["--seed", "--run", "x"], r"--seed needs a value"),
    (["extra"], r"'extra' belongs to no option"),
    (["--phases.first.levels", "[1, 2"], r"--phases\.first\.levels: '\[1, 2' cannot be read"),
]


@pytest.mark.parametrize("words, message", MISTAKES, ids=[" ".join(w) for w, _ in MISTAKES])
def test_mistakes_on_the_command_line(fakes, words, message):
    with pytest.raises(UserError, match=message) as caught:
        load_config([], words)
    assert "\n" not in str(caught.value)


FILES = [
    (
        "phases: {second: {losses: {prt: {}}}}",
        r"x\.yaml: no option '.*losses\.prt' \(did you mean 'phases\.second\.losses\.part'\?\)",
    ),
    ("seed: 1\nseed: 2", r"x\.yaml, line 2: the key 'seed' is given twice"),
    ("phases: {first: {steps: 3", r"x\.yaml, line \d: "),
    ("- 1", r"x\.yaml: expected a mapping"),
    ("include: [nowhere.yaml]", r"config file 'nowhere\.yaml' is not there"),
    ("phases: {first: 3}", r"x\.yaml: phases\.first: expected options \(key: value\) or null, got 3"),
]


@pytest.mark.parametrize("text, message", FILES, ids=[t.splitlines()[-1] for t, _ in FILES])
def test_mistakes_in_a_file_name_the_file(fakes, write, text, message):
    with pytest.raises(UserError, match=message):
        load_config([write("x.yaml", text)])


def test_a_mistake_below_another_format_is_still_found(fakes, write):
    made = write("made.yaml", "data: {format: made, knd: door}")
    with pytest.raises(UserError, match=r"made\.yaml: no option 'data\.knd' \(did you mean 'data\.kind'\?\)"):
        load_config([made], ["--data.format", "folder"])
