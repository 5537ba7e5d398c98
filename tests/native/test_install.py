"""Installing without a C++ compiler, and the pinned versions."""

import os
import re
import shutil
import subprocess
import sys
import warnings

import pytest

import p2gs.native
from p2gs.ops.ssim import l1_ssim, l1_ssim_reference


@pytest.mark.skipif(shutil.which("cmake") is None, reason="no cmake")
def test_configures_without_a_compiler(repo, tmp_path):
    environment = {**os.environ, "CXX": str(tmp_path / "no-such-compiler")}
    command = ["cmake", "-S", str(repo), "-B", str(tmp_path / "build"), f"-DPython_EXECUTABLE={sys.executable}"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "no C++ compiler found" in done.stderr
    command = ["cmake", "--install", str(tmp_path / "build"), "--prefix", str(tmp_path / "site")]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    assert (tmp_path / "site/p2gs/configs/base.yaml").is_file()
    assert not list((tmp_path / "site/p2gs").glob("_native*"))


def test_says_once_that_it_is_slow(monkeypatch):
    monkeypatch.setattr(p2gs.native, "native", None)
    monkeypatch.setattr(p2gs.native, "why_missing", "no compiler")
    monkeypatch.setattr(p2gs.native, "_warned", False)
    with pytest.warns(UserWarning, match="no compiler: using the reference rasterizer"):
        p2gs.native.warn_missing_once()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        p2gs.native.warn_missing_once()


def test_the_twins_take_over(monkeypatch):
    import torch

    monkeypatch.setattr("p2gs.ops.ssim.native", None)
    a, b = torch.rand(2, 12, 13, 3)
    assert torch.equal(l1_ssim(a, b), l1_ssim_reference(a, b))


def test_every_dependency_is_pinned(repo):
    """`make setup` installs what was tested: constraints.txt has each dependency of the package and of its dev
    extra."""

    def plain(name):
        return re.sub(r"[-_.]+", "-", name).lower()

    text = (repo / "pyproject.toml").read_text()
    wanted = re.search(r"^dependencies = \[(.*?)^\]", text, re.S | re.M).group(1) + re.search(
        r"^dev = \[(.*?)^\]", text, re.S | re.M
    ).group(1)
    names = {plain(n) for n in re.findall(r'^\s*"([A-Za-z0-9_.-]+)', wanted, re.M)}
    lines = (repo / "constraints.txt").read_text().splitlines()
    pinned = {plain(line.split("==")[0]) for line in lines if not line.startswith("#")}
    assert len(names) > 15
    assert names - pinned == set()
