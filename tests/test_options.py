"""Options as typed values: what the command line holds is what a program writes."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, dataclass, field

import click
import pytest

from casest.cli.assignments import Assignment
from casest.cli.comparing import CompareOptions
from casest.cli.correcting import ApplyOptions
from casest.cli.flags import Kind, flag, refuse, taking
from casest.cli.motion import FilterOptions, ObserveOptions
from casest.cli.options import FitOptions, ModelOptions, ReadingOptions
from casest.cli.simulating import SimulateOptions
from casest.errors import UsageError

EVERY = (ApplyOptions, CompareOptions, FilterOptions, FitOptions, ObserveOptions, SimulateOptions)


def typed(group, *words):
    """The value of a command line that has the options of `group`."""

    @click.command()
    @taking(group)
    def command(options):
        return options

    return command.main(list(words), standalone_mode=False)


@pytest.mark.parametrize("group", EVERY)
def test_a_command_without_options_has_the_defaults_of_the_value(group):
    assert typed(group) == group()


@pytest.mark.parametrize("group", EVERY)
def test_options_can_be_neither_changed_nor_misspelt(group):
    options = group()
    with pytest.raises(FrozenInstanceError):
        options.reading = ReadingOptions(rate=50.0)
    assert not hasattr(options, "__dict__")


def test_options_stand_in_their_group_with_their_type():
    words = (
        "--fix bias=1,2,3 --free norm --free gain --rate 50 --at-rest --unit v=g --seed 3 --json"
    )
    assert typed(FitOptions, *words.split()) == FitOptions(
        model=ModelOptions(fix=(Assignment("--fix", "bias=1,2,3"),), free=("norm", "gain")),
        reading=ReadingOptions(rate=50.0, at_rest=True, units=(Assignment("--unit", "v=g"),)),
        seed=3,
        as_json=True,
    )


def test_reading_options_are_the_words_of_load_runs():
    options = typed(ReadingOptions, "--columns", "v=ax,ay", "--columns", "t=0", "--scale", "v=2")
    assert options.keywords() == {
        "columns": {"v": ("ax", "ay"), "t": ("0",)},
        "units": {},
        "scales": {"v": "2"},
        "rate": None,
        "at_rest": False,
        "time_zero": "first",
    }
    assert options.of_signals({"t"}).keywords()["columns"] == {"t": ("0",)}
    assert options.of_signals({"t"}).keywords()["scales"] == {}


@dataclass(frozen=True, slots=True)
class Inner:
    still: tuple[str, ...] = flag((), "--still", only=Kind.FITTED)
    any: int = flag(0, "--any")


@dataclass(frozen=True, slots=True)
class Outer:
    inner: Inner = field(default_factory=Inner)
    moving: bool = flag(False, "-m", "--is-moving", only=Kind.MOVING)


def test_an_option_of_another_kind_of_model_is_refused_by_its_long_flag():
    options = typed(Outer, "--any", "3", "-m")
    refuse(options, Kind.FITTED, "is not asked of this one")
    with pytest.raises(UsageError, match=r"^--is-moving is for planes$"):
        refuse(options, Kind.MOVING, "is for planes")
    with pytest.raises(UsageError, match=r"^--still is for stones$"):
        refuse(typed(Outer, "--still", "a"), Kind.FITTED, "is for stones")
