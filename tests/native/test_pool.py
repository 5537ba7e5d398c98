"""The thread pool and the choice of kernels: stress, several callers, fork."""

import os
import subprocess
import sys
import threading

import pytest

from p2gs.native import native, num_threads


def test_every_chunk_once():
    for chunks in (0, 1, 2, 3, 17, 1000):
        for threads in (1, 2, 3, 8):
            assert native.pool_test(chunks, threads, 50) == chunks


def test_many_short_calls():
    for i in range(20_000):
        assert native.pool_test(1 + i % 7, 1 + i % 4, 0) == 1 + i % 7


def test_calls_after_a_pause():
    """Helpers sleep after 20 us: wake-ups must not get lost."""
    for _ in range(300):
        threading.Event().wait(0.0005)
        assert native.pool_test(8, 4, 2000) == 8


def test_several_callers():
    bad = []

    def caller(work):
        for i in range(1500):
            if native.pool_test(5 + i % 11, 4, work) != 5 + i % 11:
                bad.append(i)

    callers = [threading.Thread(target=caller, args=(work,)) for work in (0, 10, 100, 1000)]
    for t in callers:
        t.start()
    for t in callers:
        t.join()
    assert not bad


def test_after_fork():
    """A forked child has no helpers of its parent's: it must start its own, not wait for them."""
    assert native.pool_test(100, 3, 1000) == 100
    code = """
import os
from p2gs.native import native
native.pool_test(100, 3, 1000)
helpers = native.pool_size()
for _ in range(5):
    pid = os.fork()
    if pid == 0:
        ok = native.pool_size() == 0 and native.pool_test(1000, 3, 1000) == 1000 and native.pool_size() == helpers
        os._exit(0 if ok else 1)
    assert os.waitpid(pid, 0)[1] == 0
    assert native.pool_test(1000, 3, 1000) == 1000
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_fork_in_the_middle_of_calls():
    code = """
import os, threading
from p2gs.native import native
stop = threading.Event()
def busy():
    while not stop.is_set():
        native.pool_test(50, 3, 500)
threads = [threading.Thread(target=busy) for _ in range(2)]
for t in threads: t.start()
for _ in range(20):
    pid = os.fork()
    if pid == 0:
        os._exit(0 if native.pool_test(200, 3, 1000) == 200 else 1)
    assert os.waitpid(pid, 0)[1] == 0
stop.set()
for t in threads: t.join()
"""
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True, timeout=120)


def test_instruction_sets():
    names = native.available_isas()
    assert names[-1] == "portable"
    before = native.isa()
    for name in names:
        native.set_isa(name)
        assert native.isa() == name
    native.set_isa(before)
    with pytest.raises(ValueError, match="mmx"):
        native.set_isa("mmx")
    assert native.isa() == before


def test_environment_forces_an_instruction_set():
    def run(isa):
        code = "from p2gs.native import native; print(native.isa())"
        environment = {**os.environ, "P2GS_ISA": isa}
        return subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120
        )

    for name in native.available_isas():
        assert run(name).stdout.strip() == name
    wrong = run("mmx")
    assert wrong.returncode != 0 and "P2GS_ISA=mmx is not among what this machine runs" in wrong.stderr


def test_threads_are_those_of_torch(threads):
    assert num_threads() == threads
