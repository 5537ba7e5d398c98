"""``preset/smoke.yaml`` runs through on any valid scene: every kind of object that ``p2gs data synth`` knows, thin ones
that fill a twentieth of a picture among them, with 64 pixels and with 32. ``make faults``."""

import json

import pytest
from whole_runs import fit

from p2gs.data.generated.furniture import KINDS
from p2gs.data.generated.generate import synthesize

pytestmark = [pytest.mark.slow, pytest.mark.timeout(0)]


@pytest.mark.parametrize(("size", "seed"), [(64, 0), (32, 1)])
@pytest.mark.parametrize("kind", sorted(KINDS))
def test_smoke(tmp_path, kind, size, seed):
    scene = synthesize(tmp_path / "scene", seed=seed, kind=kind, size=size, train_views=8, test_views=1, depth=False)
    config = tmp_path / "smoke.yaml"
    config.write_text(f"include: [preset/smoke.yaml]\ndata: {{root: {scene}, depth: never}}\n")
    ended = fit(config, tmp_path / "run", "--threads", "1")
    assert ended.code == 0, ended.said
    assert json.loads((tmp_path / "run" / "twin.json").read_text())["num_parts"] >= 1
