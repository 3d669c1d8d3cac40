"""Options from a dataclass: what a field becomes in a parser, and back; values outside their range are refused in both ways."""

from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

import pytest

from pans.app.command import CommandParser
from pans.base.console import options as option_fields
from pans.base.errors import UsageError
from pans.base.numbers.ranges import Range
from pans.live.options import RunOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class Lamp:
    """One field of each kind."""

    place: Path = option_fields.option(Path(), "where", flag="place")
    serial: str = option_fields.option(MISSING, "which")
    level: int = option_fields.option(3, "how bright", range=Range(0, 9, whole=True))
    rate_hz: float = option_fields.option(2.5, "how often", group="blinking")
    colour: str = option_fields.option("red", "of the light", choices=lambda: ("red", "blue"))
    names: tuple[str, ...] = option_fields.option((), "of it", flag="--name", action="append")
    cooled: bool = option_fields.option(True, "do not cool", flag="--no-cooling")
    hours: float | None = option_fields.option(None, "since when", range=Range(0, 1e6), group="blinking")
    made: int = 7  # no option


def parsed(*words: str, **more: Any) -> Lamp:
    parser = CommandParser(prog="pans lamp")
    option_fields.add_options(parser, Lamp, **more)
    return option_fields.options_from(parser.parse_args(words), Lamp)


def test_defaults_are_those_of_the_fields() -> None:
    assert parsed("here", "--serial=x") == Lamp(place=Path("here"), serial="x")


def test_each_kind_of_field_comes_back() -> None:
    words = "here --serial=x --level=9 --rate-hz=1e3 --colour=blue --name=a --name=b --no-cooling --hours=2"
    others = {"rate_hz": 1e3, "colour": "blue", "names": ("a", "b"), "cooled": False, "hours": 2.0}
    wanted = Lamp(place=Path("here"), serial="x", level=9, **others)
    assert parsed(*words.split()) == wanted
    changed = option_fields.changed_options(wanted)
    assert (changed["place"], changed["names"], changed["hours"]) == ("here", ["a", "b"], 2.0)
    assert "made" not in changed
    assert option_fields.changed_options(Lamp(serial="x")) == {"serial": "x"}
    assert option_fields.words_of(Lamp(serial="x", level=4)) == ["--serial=x", "--level=4"]


REFUSED = [("--level=10", "--level"), ("--level=1.5", "whole number"), ("--rate-hz=nan", "--rate-hz"), ("", "--serial")]


@pytest.mark.parametrize(("word", "said"), [*REFUSED, ("--colour=green", "blue")])
def test_the_parser_refuses(word: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        parsed("here", *(("--serial=x", word) if word else ()))
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("changes", [{"level": 10}, {"level": True}, {"hours": -1.0}, {"colour": "green"}])
def test_a_program_s_values_are_checked_alike(changes: dict[str, Any]) -> None:
    option_fields.check_options(Lamp(serial="x"))
    with pytest.raises(UsageError, match=f"--{next(iter(changes))} is .*allowed: "):
        option_fields.check_options(Lamp(serial="x", **changes))


def test_another_command_may_omit_fields_and_groups_and_have_other_defaults() -> None:
    assert parsed("--serial=x", defaults={"level": 5}, omit=("place", "blinking")) == Lamp(serial="x", level=5)
    with pytest.raises(SystemExit):
        parsed("--serial=x", "--rate-hz=1", omit=("place", "blinking"))


def test_what_has_no_effect_is_refused() -> None:
    option_fields.refuse_without(Lamp(serial="x"), "--name", {"level": 3})
    with pytest.raises(UsageError, match="--level has no effect without --name"):
        option_fields.refuse_without(Lamp(serial="x", level=4), "--name", {"level": 3})


def test_every_default_of_a_run_is_in_its_range_and_every_option_has_a_help() -> None:
    option_fields.check_options(RunOptions())
    assert all(one.metadata["help"] for one in fields(RunOptions) if one.metadata)
