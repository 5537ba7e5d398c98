"""What a loss declares: its needs are checked when the class is made, and close over what they include."""

import pytest

from p2gs.losses.base import KINDS, LOSSES, NEEDS, Loss
from p2gs.types import UserError


def test_what_nobody_makes_is_refused():
    with pytest.raises(
        UserError, match="loss Odd: needs 'normals', which no phase makes; known: depth_sq, planes, parts"
    ):

        class Odd(Loss):
            needs = {"normals"}

    with pytest.raises(UserError, match="loss Off: kind is 'picture', expected one of image"):

        class Off(Loss):
            kind = "picture"


def test_a_loss_that_declares_nothing_gets_the_parts_and_is_ones_own():
    class Plain(Loss):
        pass

    class Pairs(Loss):
        needs = {"pairs"}

    assert Plain.needs == {"parts"} and Plain.kind == "own"
    assert Pairs.needs == {"pairs", "parts"}


def test_the_built_in_ones_declare_what_they_look_at():
    import p2gs.losses  # noqa: F401

    own = {name: loss for name, loss in LOSSES.items() if loss.__module__.startswith("p2gs.losses.")}
    assert {n for n, loss in own.items() if loss.kind == "image"} == {"render", "alpha", "depth", "surface_depth"}
    assert {n for n, loss in own.items() if "pairs" in loss.needs} == {"art", "velocity", "vector"}
    assert {n for n, loss in own.items() if "depth_sq" in loss.needs} == {"depth_variance"}
    assert {n for n, loss in own.items() if "planes" in loss.needs} == {"surface_depth"}
    assert all(loss.kind in KINDS and loss.needs <= NEEDS.keys() and loss.kind != "own" for loss in own.values())
