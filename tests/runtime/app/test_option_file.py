"""Options in a file: every option of `pans run` there and back, the command line above the file, and what a file cannot mean."""

import argparse
import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from commands import Pans

from pans.app.command import parser_of
from pans.app.main import main
from pans.app.option_file import HERE, prepare_options, write_options
from pans.app.run.command import RUN
from pans.base import SHIPPED
from pans.base.errors import ConfigError

NEEDED = ("b.pans", "--device", "sim:ideal")
NUMBERS = ("3", "0.5", "2048", "1")


def parsed(*words: str) -> argparse.Namespace:
    """What `pans run` makes of its words."""
    parser = parser_of("run", RUN)
    return parser.parse_args(prepare_options(parser, words))


def options() -> list[argparse.Action]:
    parser: argparse.ArgumentParser = parsed(*NEEDED).option_parser
    return [action for action in parser._actions if action.dest not in HERE]


def words_for(action: argparse.Action) -> list[str]:
    """Words that give one option a value other than its default."""
    name = max(action.option_strings, key=len, default="")
    before = [name] if name else []
    if action.nargs == 0:
        return before
    if action.choices:
        return [*before, next(str(choice) for choice in action.choices if choice != action.default)]
    if not callable(action.type) or action.type is Path:
        return [*before, 'a "name" \\ of # Größe\t1']
    for text in NUMBERS:
        try:
            if action.type(text) != action.default:
                return [*before, text]
        except (ValueError, argparse.ArgumentTypeError):
            continue
    raise AssertionError(f"no value for {name}")


def facts(args: argparse.Namespace) -> dict[str, Any]:
    return {key: value for key, value in vars(args).items() if key not in (*HERE, "option_parser")}


@pytest.mark.parametrize("action", options(), ids=lambda action: action.dest)
def test_every_option_comes_back_from_a_file(action: argparse.Action, tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    needed = NEEDED[1:] if not action.option_strings else NEEDED[:1] if action.dest == "device" else NEEDED
    given = parsed(*needed, *words_for(action), "--write-config", str(path))
    assert facts(given)[action.dest] != action.default
    write_options(given)
    assert facts(parsed("--config", str(path))) == facts(given)
    key = max(action.option_strings, key=len, default=action.dest).lstrip("-")
    assert set(tomllib.loads(path.read_text())) == {"bundle", "device", key}  # the rest are comments
    assert all(f"# {other.help}"[:20] in path.read_text() for other in options() if other.help)


def test_the_command_line_overrides_the_file(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(
        'bundle = "a.pans"\ndevice = "sim:ideal"\nshots = 4\nno-realtime = true\ngate-class = ["a", "b"]\nrotate-mb = 2\n'
    )
    args = parsed("--config", str(path))
    assert (args.bundle, args.shots, args.realtime, args.gate_class) == (Path("a.pans"), 4, False, ["a", "b"])
    assert args.rotate_mb == 2
    args = parsed("c.pans", "--config", str(path), "--shots", "1", "--gate-class", "x", "--gate-class=y")
    assert (args.bundle, args.shots, args.gate_class) == (Path("c.pans"), 1, ["x", "y"])
    args = parsed(f"--config={path}", "--unset", "no-realtime", "--unset=--shots")
    assert (args.realtime, args.shots) == (True, 1)


@pytest.mark.parametrize(
    ("line", "wrong"),
    [
        ("shotss = 3", r":1:1: shotss: there is no such option"),
        ("no_realtime = true", r"there is no such option"),
        ("config = 'x'", r"there is no such option"),
        ("\n shots = 0", r":2:2: shots: '0' is not a whole number from 1"),
        ("shots = 1.5", r"shots: '1.5' is not a whole number"),
        ("shots = true", r"shots: found true, allowed: a number or a text"),
        ("seconds = nan", r"'nan' is not a number"),
        ("seconds = [1]", r"found \[1\], allowed: a number or a text"),
        ("order = 'sideways'", r"order: .*invalid choice: 'sideways'"),
        ("no-realtime = 1", r"no-realtime: found 1, allowed: true or false"),
        ("gate-class = 'a'", r"gate-class: found \"a\", allowed: a list"),
        ("profile = 3", r"profile: found 3, allowed: a text in quotes"),
        ("run = 2026-01-01", r"there is no such option"),
        ("seconds = 2026-01-01", r"allowed: a number or a text"),
        ("= 3", r":1:1: .*"),
        ("a" * 3 + ".b" * 2000 + " = 3", r"with 100 dots"),
    ],
)
def test_what_a_file_cannot_mean(line: str, wrong: str, tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(line + "\n")
    with pytest.raises(ConfigError, match=wrong) as caught:
        parsed(*NEEDED, "--config", str(path))
    assert caught.value.message.startswith(str(path))
    assert line != "no_realtime = true" or caught.value.remedy == "did you mean no-realtime?"


def test_the_command_writes_reads_and_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pans: Pans) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["run", str(SHIPPED / "fashion10.pans"), "--device", "sim:oled-qcmos?pace=fast&seed=2", "--decisions", "4"]
    assert main([*words, "--write-config", "lab.toml"]) == 0
    assert "pans run --config lab.toml" in pans.said().out
    assert [path.name for path in tmp_path.iterdir()] == ["lab.toml"]  # nothing has run
    assert main([*words, "--write-config", "lab.toml"]) == 2
    assert main([*words, "--config", "lab.toml", "--write-config", "lab.toml", "--force"]) == 2  # its own input
    pans.said()
    assert main(["run", "--config", "lab.toml", "--decisions", "3", "--out", "out", "--json"]) in (0, 1)
    assert json.loads(pans.said().out)["decisions"] == 3
    assert "is the input" in pans.refuses("run", "--config", "lab.toml", "--record", "lab.toml", "--force")
    assert "remedy: " in pans.refuses("run", "--config", "none.toml")
