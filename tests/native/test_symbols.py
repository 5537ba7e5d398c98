"""Nothing of one instruction set may stand in for another's code: a shared inline function compiled for AVX-512 would
crash elsewhere."""

import shutil
import subprocess

import pytest


@pytest.mark.parametrize("isa", ["avx512", "avx2", "portable"])
def test_objects_define_only_their_own_namespace(repo, isa):
    built = [
        repo / "build" / name / f"CMakeFiles/_native.dir/p2gs/native/isa_{isa}.cpp.o" for name in ("native", "editable")
    ]
    built = [path for path in built if path.exists()]
    if not built or not shutil.which("nm"):
        pytest.skip("no object files of a build, or no nm to read them with")
    for path in built:
        out = subprocess.run(
            ["nm", "-C", "--defined-only", "--extern-only", path], capture_output=True, text=True, check=True
        ).stdout
        names = [line.split(maxsplit=2)[2] for line in out.splitlines()]
        assert names, path
        # gcc's pointer to the C++ runtime's own exception handler: data, the same for every instruction set
        foreign = [name for name in names if not name.startswith((f"p2gs::{isa}::", "DW.ref.__gxx_personality"))]
        assert foreign == []
