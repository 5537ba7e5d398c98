"""The fingerprint of code: what changes it, what does not, and that it is quick."""

import sys
import time

import pytest

from p2gs.runtime.code import CodeReader, read_source

BASE = '''
"""Doc."""
import helper

def f(x):
    """What it does."""
    return helper.g(x) + 1
'''


def tree(text: str) -> str:
    return read_source(text.encode()).tree


@pytest.mark.parametrize(
    "old, new, same",
    [
        ('"""Doc."""', '"""Other words."""', True),
        ('    """What it does."""\n', "", True),
        ("return helper.g(x) + 1", "return (helper.g(x)\n        + 1)  # why", True),
        ("+ 1", "+ 2", False),
        ("def f(x)", "def f(x=0)", False),
    ],
)
def test_what_counts(old, new, same):
    assert old in BASE and (tree(BASE) == tree(BASE.replace(old, new))) is same


def test_imports_inside_functions_count():
    assert read_source(b"def f():\n    from a.b import c\n    import d.e\n").imports == ("a.b.c", "d.e")


@pytest.fixture
def package(tmp_path, monkeypatch):
    """own/ with top -> middle -> deep, and other, which nothing imports."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = tmp_path / "own_fingerprint"
    folder.mkdir()
    for name, text in {
        "__init__": "",
        "top": "from own_fingerprint import middle\nimport json",
        "middle": "def f():\n    from own_fingerprint.deep import value\n    return value",
        "deep": "value = 1",
        "other": "value = 1",
    }.items():
        (folder / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    return folder


def codes() -> dict:
    return CodeReader().code_of(["own_fingerprint.top"])


def test_a_module_far_below_counts_and_one_beside_does_not(package):
    before = codes()
    assert set(before) == {"own_fingerprint", "own_fingerprint.top", "own_fingerprint.middle", "own_fingerprint.deep"}
    (package / "other.py").write_text("value = 2")
    (package / "middle.py").write_text((package / "middle.py").read_text() + "  # a remark")
    assert codes() == before
    (package / "deep.py").write_text("value = 2")
    assert {name for name, code in codes().items() if before[name] != code} == {"own_fingerprint.deep"}
    assert not any(name.startswith("own_fingerprint") for name in sys.modules)  # nothing was imported


def test_a_damaged_or_unwritable_cache_is_made_again(package, tmp_path, monkeypatch):
    before = codes()
    cache = tmp_path / "cache" / "p2gs" / "code.json"
    assert cache.is_file()
    for damage in ("", "[1]", '{"3.11-x": 5}'):
        cache.write_text(damage)
        assert codes() == before
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc/none")
    assert codes() == before


def test_the_whole_package_is_read_in_half_a_second():
    modules = ["p2gs.runtime.finish", "p2gs.models.articulation"]
    code = CodeReader().code_of(modules)  # fills the cache
    began = time.process_time()
    assert CodeReader().code_of(modules) == code
    assert time.process_time() - began < 0.5
    assert "p2gs.export.files.urdf" in code and "native kernels" in code and "p2gs.cli" not in code


def test_a_single_state_does_not_hang_on_discovery():
    """An edit of discovery must not make both reconstructions again."""
    code = CodeReader().code_of(["p2gs.models.single_state"])
    assert "p2gs.gaussians.splats" in code and not [m for m in code if "discovery" in m or m.startswith("p2gs.export")]
