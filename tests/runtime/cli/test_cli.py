"""The command line's contract: exit codes, where output goes, errors without a traceback."""

from __future__ import annotations

import argparse
import errno
import json
import os
import re
import shlex
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from pans.runtime import __version__, cli
from pans.runtime.cli import Command, finding, main, printing
from pans.runtime.cli.command import parser_of
from pans.runtime.errors import DamagedFileError, LinkError, UsageError


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
    monkeypatch.setattr(finding, "entry_points", lambda group: [Point(name, loaded) for name, loaded in table.items()])
    return table


OUTCOMES = [(0, 0), (1, 1), (4, 4), (UsageError("x"), 2), (DamagedFileError("x"), 2), (LinkError("x"), 3)]


@pytest.mark.parametrize(("outcome", "code"), [*OUTCOMES, (KeyboardInterrupt(), 130)])
def test_exit_codes(installed: dict[str, object], outcome: object, code: int) -> None:
    installed["lab"] = command(outcome)
    assert main(["lab"]) == code


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
    assert main(["lab", "--json"]) == cli.EXIT_INTERNAL


def test_a_missing_extra_says_how_to_get_it(installed: dict[str, object], capsys: pytest.CaptureFixture[str]) -> None:
    installed["train"] = ModuleNotFoundError("No module named 'torch'", name="torch")
    assert main(["train"]) == 2
    assert "pip install 'pans-runtime[train]'" in capsys.readouterr().err


def test_the_version_and_the_list_survive_a_broken_command(
    installed: dict[str, object], capsys: pytest.CaptureFixture[str]
) -> None:
    installed["good"] = command(0)
    installed["broken"] = ImportError("a lab's own mistake")
    for option in ("-V", "--version"):
        assert said([option], capsys) == (0, f"pans {__version__}\n", "")
    code, out, _ = said([], capsys)
    assert code == 0
    assert "good    a lab's own command" in out
    assert "a lab's own mistake" in out


def test_the_list_of_commands_loads_none_of_them() -> None:
    code = "import sys; from pans.runtime.cli import main; main([]); print('numpy' in sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stderr == "False\n"
    assert "usage: pans COMMAND" in done.stdout


def said(words: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of one command line."""
    capsys.readouterr()
    try:
        code = main(words)
    except SystemExit as end:
        code = int(end.code or 0)
    return code, *capsys.readouterr()


@pytest.mark.parametrize(
    ("words", "where", "remedy"),
    [
        (["verify", "--jsn", "x"], "", "did you mean --json? `pans help verify` lists the options"),
        (["run", "b.pans", "--device", "x", "--seconds", "nan"], "--seconds", "`pans help run` lists the options"),
        (["verify"], "", "`pans help verify` lists the options"),
        (["verify", "none.pans"], "none.pans", None),
        (["verfy"], "", "did you mean verify? `pans` lists the commands"),
        (["--loud"], "", "name a command first: `pans` lists them"),
    ],
)
def test_with_json_every_error_is_one_object(
    words: list[str], where: str, remedy: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = said([*words, "--json"], capsys)
    error = json.loads(out)["error"]
    assert code == error["exit"] == 2
    assert set(error) == {"message", "where", "remedy", "exit"}
    assert error["where"] == where
    assert error["remedy"] == remedy if remedy else error["remedy"]
    assert f"pans: {error['message']}\n  remedy: {error['remedy']}\n" in err


def test_interrupted_with_json_is_one_object(installed: dict[str, object], capsys: pytest.CaptureFixture[str]) -> None:
    installed["lab"] = command(KeyboardInterrupt())
    assert said(["lab", "--json"], capsys)[:2] == (
        130,
        '{"error": {"message": "interrupted", "where": "", "remedy": "", "exit": 130}}\n',
    )
    installed["lab"] = command(130)  # a command that told it by itself, with figures
    assert json.loads(said(["lab", "--json"], capsys)[1]) == {"value": 0.5, "array": [0, 1]}


def test_a_signal_is_named_on_the_screen_and_in_the_log(
    installed: dict[str, object], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    installed["lab"] = command(KeyboardInterrupt("stopped by SIGTERM"))
    code, _, err = said(["lab", "--log-file", str(tmp_path / "lab.log")], capsys)
    assert (code, err) == (130, "pans: stopped by SIGTERM\n")
    assert "ends: stopped by SIGTERM" in (tmp_path / "lab.log").read_text()


def test_errors_of_the_system_are_told_and_others_are_faults_of_ours(
    installed: dict[str, object], capsys: pytest.CaptureFixture[str]
) -> None:
    installed["lab"] = command(OSError(errno.ENOSPC, "No space left on device", "run.pansrec"))
    code, out, err = said(["lab"], capsys)
    assert (code, out) == (2, "")
    assert err.startswith("pans: run.pansrec: No space left on device\n  remedy: make room")
    installed["lab"] = command(ZeroDivisionError("of ours"))
    code, out, err = said(["lab"], capsys)
    assert code == cli.EXIT_INTERNAL
    assert "internal error: ZeroDivisionError: of ours (test_cli.py:" in err
    with pytest.raises(ZeroDivisionError):
        main(["lab", "--debug"])


def test_quiet_and_verbose(installed: dict[str, object], capsys: pytest.CaptureFixture[str]) -> None:
    def run(args: argparse.Namespace) -> int:
        cli.say("on the way")
        cli.note("in detail")
        cli.warn("careful")
        cli.emit(args, {}, "answer")
        return 0

    installed["lab"] = Command("x", lambda parser: None, run)
    assert said(["lab"], capsys)[1:] == ("answer\n", "on the way\npans: warning: careful\n")
    assert said(["lab", "-q"], capsys)[1:] == ("answer\n", "pans: warning: careful\n")
    assert "in detail\n" in said(["lab", "-v"], capsys)[2]


def test_a_labs_command_may_use_a_short_option_for_itself(
    installed: dict[str, object], capsys: pytest.CaptureFixture[str]
) -> None:
    def configure(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("-v", type=int)

    installed["lab"] = Command("x", configure, lambda args: int(args.v))
    assert said(["lab", "-v", "1"], capsys)[0] == 1


def test_a_slow_command_shows_that_it_began(installed: dict[str, object], capsys: pytest.CaptureFixture[str]) -> None:
    began = threading.Event()

    def run(args: argparse.Namespace) -> int:
        while not printing.state.said:  # pytest's time limit is the only clock here
            began.wait(0.01)
        return 0

    installed["lab"] = Command("x", lambda parser: None, run)
    assert said(["lab"], capsys) == (0, "", "pans lab: loading ...\n")


def test_every_example_of_a_command_can_be_parsed() -> None:
    for name, point in finding.find_commands().items():
        try:
            found = finding.load_command(point)
        except UsageError:
            continue  # its extra is not installed
        assert parser_of(name, found).format_help()  # a bare % in a help text would raise
        for line in found.examples:
            for words in re.findall(rf"pans {name}( [^|>)]*)?", line):
                parser_of(name, found).parse_args(shlex.split(words))


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_an_answer_that_cannot_be_written_is_an_error_without_a_traceback() -> None:
    words = [sys.executable, "-m", "pans", "help"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("pans: No space left on device\n  remedy: make room")
