"""The config's stages: an order that cannot work is refused in one sentence before anything is computed."""

from types import SimpleNamespace

import pytest

from p2gs.models.stage import PHASES, Stage, register_phase
from p2gs.runtime.order import stage_order
from p2gs.types import UserError


@pytest.fixture
def phases(monkeypatch):
    """first gives a; second turns a into b; third gives b anew and uses c."""
    monkeypatch.setattr(PHASES, "_items", {})

    @register_phase("first")
    class First(Stage):
        gives = "a"

        @classmethod
        def compute(cls, run, section):
            return 1

    @register_phase("second")
    class Second(First):
        needs, gives = ("a",), "b"

    @register_phase("third")
    class Third(First):
        needs, uses, gives = ("b",), ("c",), "b"


def run(*stages, options=None):
    return SimpleNamespace(
        cfg=SimpleNamespace(stages=list(stages), phases=dict.fromkeys(stages if options is None else options))
    )


def test_the_order_is_the_configs(phases):
    assert list(stage_order(run("first", "second", "third"))) == ["first", "second", "third"]


@pytest.mark.parametrize(
    "stages, options, message",
    [
        (["first", "secnd"], None, "there is no phase 'secnd' (did you mean 'second'?)"),
        (["first", "first"], None, "'first' is named twice"),
        (
            ["second", "first"],
            None,
            "second needs 'a', which no stage before it hands over (first does, and comes later)",
        ),
        (["first", "third"], None, "third needs 'b', which no stage before it hands over"),
        (["first", "second"], ["first"], "phases.second is not in the config"),
        (
            ["first"],
            ["first", "second"],
            "phases.second is in the config but not among the stages (first), so it would never run",
        ),
    ],
)
def test_what_cannot_work_is_told(phases, stages, options, message):
    with pytest.raises(UserError) as told:
        stage_order(run(*stages, options=options))
    assert message in str(told.value) and "\n" not in str(told.value)


def test_a_class_that_does_not_say_how_it_takes_part_is_named(phases):
    @register_phase("silent")
    class Silent(Stage):
        needs = ("a",)

    @register_phase("idle")
    class Idle(Stage):
        gives = "c"

    PHASES.register("foreign")(type("Foreign", (), {}))
    for name, message in (
        ("silent", "does not say what it hands over"),
        ("idle", "has to define compute"),
        ("foreign", "is no Stage"),
    ):
        with pytest.raises(UserError, match=message):
            stage_order(run("first", name))


def test_names_of_states_are_taken():
    with pytest.raises(ValueError, match="_0 or _1"):
        register_phase("mine_0")


def test_the_built_in_phases_fit_together():
    from p2gs.config.keys import STAGES
    from p2gs.config.run import import_builtins

    import_builtins()
    order = stage_order(run(*STAGES))
    assert [p.gives for p in order.values()] == [
        "states",
        "states",
        "sharpened",
        "motions",
        "canonical",
        "learned",
        "twin",
    ]
