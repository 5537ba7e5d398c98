"""Whose threads work: torch's own or the kernels'."""

import threading

import pytest
import torch

from p2gs.native import at_once, num_threads, serial_torch


def threads_now():
    return torch.get_num_threads(), num_threads()


def test_kernels_keep_the_threads_that_torch_had():
    torch.set_num_threads(3)
    with serial_torch():
        assert threads_now() == (1, 3)
        with serial_torch():  # one inside another changes nothing
            assert threads_now() == (1, 3)
        assert threads_now() == (1, 3)
    assert threads_now() == (3, 3)


def test_given_back_after_an_error():
    torch.set_num_threads(2)
    with pytest.raises(KeyError), serial_torch():
        raise KeyError
    assert threads_now() == (2, 2)


def test_switched_off():
    torch.set_num_threads(2)
    with serial_torch(on=False):
        assert threads_now() == (2, 2)


def test_jobs_at_once_have_a_thread_each_and_answer_in_order():
    torch.set_num_threads(2)
    met = threading.Barrier(2, timeout=20)  # a job alone would wait in vain

    def job(number):
        met.wait()
        return number, threads_now(), torch.is_grad_enabled(), at_once(lambda _: threads_now(), [0])

    with torch.no_grad():
        done = at_once(job, range(4))
    assert done == [(number, (1, 1), False, [(1, 1)]) for number in range(4)]
    assert threads_now() == (2, 2)


def test_jobs_at_once_are_ones_own_with_one_thread():
    torch.set_num_threads(1)
    assert at_once(lambda _: threading.get_ident(), range(3)) == [threading.get_ident()] * 3


def test_an_error_of_a_job_is_raised_and_threads_are_given_back():
    torch.set_num_threads(2)
    with pytest.raises(ZeroDivisionError):
        at_once(lambda n: 1 // n, [1, 0])
    assert threads_now() == (2, 2) and at_once(lambda n: n, [1, 2]) == [1, 2]
