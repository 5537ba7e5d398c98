"""Whose threads work: torch's own or the kernels'."""

import pytest
import torch

from p2gs.native import num_threads, serial_torch


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
