"""The basin of a bench: success by opening, the largest opening that two of three seeds solve."""

import json

import pytest

from p2gs.bench.basin import basin, main, markdown, outcomes
from p2gs.types import UserError


@pytest.fixture
def bench(tmp_path):
    """``bench({(setting, opening): [(axis, motion) or None, one a seed]})`` -> the folder."""

    def make(results, name="door_{:02d}"):
        (tmp_path / "cells.json").write_text("{}")
        for (setting, opening), seeds in results.items():
            for seed, errors in enumerate(seeds):
                folder = tmp_path / "runs" / setting / name.format(opening) / f"seed{seed}"
                folder.mkdir(parents=True)
                found = None if errors is None else {"axis_angle": errors[0], "axis_position": 0.0, "motion": errors[1]}
                (folder / "metrics.json").write_text(json.dumps({"joints": {"joints": [{"errors": found}]}}))
        return tmp_path

    return make


def test_two_of_three_seeds_solve_an_opening(bench):
    good, bad = (0.2, 0.9), (0.2, 1.1)
    folder = bench(
        {
            ("ours", 5): [good] * 3,
            ("ours", 30): [good, None, good],
            ("ours", 60): [good, bad, None],
            ("random", 5): [bad] * 3,
        }
    )
    found = outcomes(folder)
    assert (
        basin([r for r in found if r.setting == "ours"]) == 30
        and basin([r for r in found if r.setting == "random"]) is None
    )
    assert "| ours | 3 of 3 | 2 of 3 | 1 of 3 | 30 deg |" in markdown(
        found
    ) and "| random | 0 of 3 |  |  | none |" in markdown(found)
    assert main([str(folder)]) == 0 and (folder / "tables" / "basin.md").read_text() == markdown(found)
    assert len((folder / "tables" / "basin.csv").read_text().splitlines()) == 1 + len(found)


def test_one_seed_makes_no_basin_and_is_told_beside_it(bench):
    good, bad = (0.2, 0.9), (0.2, 1.1)
    runs = {("ours", 20): [good, good, bad], ("ours", 45): [good], ("lucky", 20): [good], ("lucky", 45): [bad]}
    text = markdown(outcomes(bench(runs)))
    assert "| ours | 2 of 3 | 1 of 1 | 20 deg (45 by one seed) |" in text
    assert "| lucky | 1 of 1 | 0 of 1 | none (20 by one seed) |" in text


def test_mistakes_are_told(bench, tmp_path, capsys):
    with pytest.raises(UserError, match="no cells.json"):
        outcomes(tmp_path)
    assert main([str(tmp_path)]) == 1 and capsys.readouterr().err.startswith("error: ")
    with pytest.raises(UserError, match="NAME_<degrees>"):
        outcomes(bench({("ours", 5): [None]}, name="door"))
