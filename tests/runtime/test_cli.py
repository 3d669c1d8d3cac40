"""The command line's contract: exit codes, where output goes, errors without a traceback."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys

import numpy as np
import pytest

from pans.runtime import __version__, cli
from pans.runtime.cli import Command, main
from pans.runtime.errors import DamagedFileError, LinkError, PansError, TimingError, UsageError


class Point:
    """An entry point that is not installed."""

    value, group, dist = "lab.package:COMMAND", "pans.commands", None

    def __init__(self, name: str, loaded: object) -> None:
        self.name, self.loaded = name, loaded

    def load(self) -> object:
        if isinstance(self.loaded, Exception):
            raise self.loaded
        return self.loaded


def command(outcome: object) -> Command:
    def run(args: argparse.Namespace) -> int:
        if isinstance(outcome, BaseException):
            raise outcome
        cli.emit(args, {"value": np.float32(0.5), "array": np.arange(2)}, "words")
        return int(outcome)  # type: ignore[call-overload]

    return Command("a lab's own command", lambda parser: None, run)


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    table: dict[str, object] = {}
    monkeypatch.setattr(cli, "entry_points", lambda group: [Point(name, loaded) for name, loaded in table.items()])
    return table


@pytest.mark.parametrize(
    ("outcome", "code"),
    [
        (0, 0),
        (1, 1),
        (UsageError("x"), 2),
        (DamagedFileError("x"), 2),
        (LinkError("x"), 3),
        (TimingError("x"), 4),
        (KeyboardInterrupt(), 130),
    ],
)
def test_exit_codes(installed: dict[str, object], outcome: object, code: int) -> None:
    installed["lab"] = command(outcome)
    assert main(["lab"]) == code


def test_an_error_is_two_lines_on_stderr_and_nothing_on_stdout(
    installed: dict[str, object], capsys: pytest.CaptureFixture[str]
) -> None:
    installed["lab"] = command(PansError("what happened", remedy="do this"))
    main(["lab", "--json"])
    out, err = capsys.readouterr()
    assert out == ""
    assert err == "pans: what happened\n  remedy: do this\n"


def test_debug_shows_the_traceback(installed: dict[str, object]) -> None:
    installed["lab"] = command(PansError("what happened"))
    with pytest.raises(PansError):
        main(["lab", "--debug"])


def test_json_is_one_object_with_plain_numbers(
    installed: dict[str, object], capsys: pytest.CaptureFixture[str]
) -> None:
    installed["lab"] = command(0)
    main(["lab", "--json"])
    assert json.loads(capsys.readouterr().out) == {"value": 0.5, "array": [0, 1]}
    main(["lab"])
    assert capsys.readouterr().out == "words\n"


def test_nan_never_reaches_a_script(installed: dict[str, object]) -> None:
    def run(args: argparse.Namespace) -> int:
        cli.emit(args, {"value": float("nan")})
        return 0

    installed["lab"] = Command("x", lambda parser: None, run)
    with pytest.raises(ValueError, match="Out of range"):
        main(["lab", "--json"])


def test_a_missing_extra_says_how_to_get_it(installed: dict[str, object], capsys: pytest.CaptureFixture[str]) -> None:
    installed["train"] = ModuleNotFoundError("No module named 'torch'", name="torch")
    assert main(["train"]) == 2
    assert "pip install 'pans-runtime[train]'" in capsys.readouterr().err


def test_the_list_survives_a_broken_command(installed: dict[str, object], capsys: pytest.CaptureFixture[str]) -> None:
    installed["good"] = command(0)
    installed["broken"] = ImportError("a lab's own mistake")
    assert main([]) == 0
    out = capsys.readouterr().out
    assert "good       a lab's own command" in out
    assert "a lab's own mistake" in out


def test_an_unknown_command_names_its_neighbours(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verfy"]) == 2
    assert "did you mean verify?" in capsys.readouterr().err


def test_version_and_help_of_the_installed_program() -> None:
    for words, wanted in ((["--version"], f"pans {__version__}\n"), ([], "usage: pans COMMAND")):
        done = subprocess.run(
            [sys.executable, "-c", "import sys; from pans.runtime.cli import main; sys.exit(main())", *words],
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0
        assert wanted in done.stdout


def test_the_list_of_commands_loads_none_of_them() -> None:
    code = "import sys; from pans.runtime.cli import main; main([]); print('numpy' in sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stderr == "False\n"
