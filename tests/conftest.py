"""What all tests share: the scenes, a fixed seed, and threads that leave the machine usable."""

from __future__ import annotations

import importlib.util
import os
import random
import sys
from pathlib import Path

# before torch: spinning threads would take the cores from the kernels
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
if "PYTEST_XDIST_WORKER_COUNT" in os.environ:  # of several processes (pytest -n) each has its share of the cores
    _processes = int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
    os.environ.setdefault("OMP_NUM_THREADS", str(max((os.cpu_count() or 1) // _processes, 1)))

import numpy as np
import pytest
import torch

import p2gs

if "P2GS_NATIVE_FILE" in os.environ:  # another build of the kernels, as `make sanitize` wants it
    _spec = importlib.util.spec_from_file_location("p2gs._native", os.environ["P2GS_NATIVE_FILE"])
    p2gs._native = sys.modules["p2gs._native"] = importlib.util.module_from_spec(_spec)
    _spec.loader.exec_module(p2gs._native)


@pytest.fixture(scope="session")
def repo() -> Path:
    """The repository's root."""
    return Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def scenes(repo: Path) -> Path:
    """The folder of two-state scenes beside the repository; skips where there is none."""
    path = repo.parent / "shared" / "scenes"
    if not path.is_dir():
        pytest.skip(f"no scenes at {path}")
    return path


@pytest.fixture(autouse=True)
def _deterministic():
    """Every test starts from the same random state and gives the thread count back."""
    threads = torch.get_num_threads()
    random.seed(0)
    np.random.seed(0)
    torch.manual_seed(0)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(params=["avx512", "avx2", "portable"])
def isa(request):
    """Each instruction set in turn; skips those that this machine does not run."""
    from p2gs.native import native, why_missing

    if native is None:
        pytest.skip(why_missing)
    if request.param not in native.available_isas():
        pytest.skip(f"this machine does not run {request.param}")
    before = native.isa()
    native.set_isa(request.param)
    yield request.param
    native.set_isa(before)


@pytest.fixture(params=[1, 2])
def threads(request) -> int:
    """Torch's (and the kernels') thread count, one and two in turn."""
    torch.set_num_threads(request.param)
    return request.param
