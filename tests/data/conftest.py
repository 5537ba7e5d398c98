"""Small generated scenes in each layout, written once; a test that breaks a scene takes a copy."""

from __future__ import annotations

import shutil

import pytest
import torch

from p2gs.data.generated.synthetic import make_object, synthetic_scene
from p2gs.data.generated.write import write_scene

SIZE, TRAIN, TEST = 40, 8, 2


@pytest.fixture(autouse=True)
def _one_thread():
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def toy():
    """A lid on a box: one revolute joint."""
    return make_object("lid_box", 1)


@pytest.fixture(scope="session")
def toy_scene(toy):
    return synthetic_scene(toy, SIZE, TRAIN, TEST, seed=5)


@pytest.fixture(scope="session")
def written(tmp_path_factory, toy):
    """Folder of the toy in each layout; read-only by agreement."""
    root = tmp_path_factory.mktemp("layouts")
    return {f: write_scene(toy, root / f, f, SIZE, TRAIN, TEST, seed=5) for f in ("artgs", "dta", "paris")}


@pytest.fixture
def copy_of(written, tmp_path):
    """A copy of one layout's folder, to break."""

    def copy(format: str):
        return shutil.copytree(written[format], tmp_path / format)

    return copy
