"""The command line's contract: exit codes, where output goes, errors without a traceback."""

import argparse
import errno
import json
import os
import re
import shlex
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import fixed_run

from pans.app import find_commands as finding
from pans.app.command import Command, parser_of
from pans.app.main import main
from pans.base import __version__
from pans.base.console import emit, note, printing, say, warn
from pans.base.errors import EXIT_INTERNAL, DamagedFileError, LinkError, UsageError


class Point:
    """An entry point that is not installed."""

    value, group, dist = "lab.package:COMMAND", "pans.commands", None

    def __init__(self, name: str, loaded: object) -> None:
        self.name, self.loaded = name, loaded

    def load(self) -> object:
        if isinstance(self.loaded, Exception):
            raise self.loaded
        return self.loaded


Said = Callable[..., tuple[int, str, str]]


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Said:
    """A call of `pans` with a command line, which returns exit code, stdout and stderr."""

    def call(line: str) -> tuple[int, str, str]:
        capsys.readouterr()
        try:
            code = main(line.split())
        except SystemExit as end:
            code = int(end.code or 0)
        return code, *capsys.readouterr()

    return call


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    table: dict[str, object] = {}
    monkeypatch.setattr(finding, "entry_points", lambda group: [Point(name, loaded) for name, loaded in table.items()])
    return table


@pytest.fixture
def lab(installed: dict[str, object], said: Said) -> Said:
    """A call of a lab's own command that ends with `outcome`: an exit code after its answer, an exception, or a call's result."""

    def call(outcome: Any, options: str = "", configure: Any = lambda parser: None) -> tuple[int, str, str]:
        def run(args: argparse.Namespace) -> int:
            if isinstance(outcome, BaseException):
                raise outcome
            if callable(outcome):
                return int(outcome(args) or 0)
            emit(args, {"value": np.float32(0.5), "array": np.arange(2)}, "words")
            return int(outcome)

        installed["lab"] = Command("a lab's own command", configure, run)
        return said(f"lab {options}")

    return call


OUTCOMES = [(0, 0), (1, 1), (4, 4), (UsageError("x"), 2), (DamagedFileError("x"), 2), (LinkError("x"), 3)]


@pytest.mark.parametrize(("outcome", "code"), [*OUTCOMES, (KeyboardInterrupt(), 130)])
def test_exit_codes(lab: Said, outcome: object, code: int) -> None:
    assert lab(outcome)[0] == code


def test_json_is_one_object_with_plain_numbers_and_nan_never_reaches_a_script(lab: Said) -> None:
    assert json.loads(lab(0, "--json")[1]) == {"value": 0.5, "array": [0, 1]}
    assert lab(0)[1] == "words\n"
    assert lab(lambda args: emit(args, {"value": float("nan")}), "--json")[0] == EXIT_INTERNAL


def test_a_missing_extra_says_how_to_get_it(installed: dict[str, object], said: Said) -> None:
    installed["train"] = ModuleNotFoundError("No module named 'torch'", name="torch")
    code, _, err = said("train")
    assert (code, "pip install 'torch==2.13.0' onnx pillow" in err) == (2, True)


def test_the_version_and_the_list_survive_a_broken_command(lab: Said, installed: dict[str, object], said: Said) -> None:
    lab(0)
    installed["broken"] = ImportError("a lab's own mistake")
    for option in ("-V", "--version"):
        assert said(option) == (0, f"pans {__version__}\n", "")
    code, out, _ = said("")
    assert code == 0
    assert "  lab         a lab's own command\n" in out
    assert "a lab's own mistake" in out


def test_the_list_of_commands_loads_none_of_them() -> None:
    code = "import sys; from pans.app.main import main; main([]); print('numpy' in sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stderr == "False\n"
    assert "usage: pans COMMAND" in done.stdout


@pytest.mark.parametrize(
    ("line", "where", "remedy"),
    [
        ("verify --jsn x", "", "did you mean --json? `pans help verify` lists the options"),
        ("run b.pans --device x --seconds nan", "--seconds", "`pans help run` lists the options"),
        ("verify", "", "`pans help verify` lists the options"),
        ("verify none.pans", "none.pans", ""),
        ("verfy", "", "did you mean verify? `pans` lists the commands"),
        ("--loud", "", "name a command first: `pans` lists them"),
    ],
)
def test_with_json_every_error_is_one_object(line: str, where: str, remedy: str, said: Said) -> None:
    code, out, err = said(f"{line} --json")
    error = json.loads(out)["error"]
    assert set(error) == {"message", "where", "remedy", "exit"}
    assert (code, error["exit"], error["where"], error["remedy"]) == (2, 2, where, remedy or error["remedy"])
    assert f"pans: {error['message']}\n  remedy: {error['remedy']}\n" in err


def test_interrupted_with_json_is_one_object(lab: Said) -> None:
    answer = '{"error": {"message": "interrupted", "where": "", "remedy": "", "exit": 130}}\n'
    assert lab(KeyboardInterrupt(), "--json")[:2] == (130, answer)
    # a command that told it by itself, with figures
    assert json.loads(lab(130, "--json")[1]) == {"value": 0.5, "array": [0, 1]}


def test_a_signal_is_named_on_the_screen_and_in_the_log(lab: Said, tmp_path: Path) -> None:
    code, _, err = lab(KeyboardInterrupt("stopped by SIGTERM"), f"--log-file {tmp_path / 'lab.log'}")
    assert (code, err) == (130, "pans: stopped by SIGTERM\n")
    assert "ends: stopped by SIGTERM" in (tmp_path / "lab.log").read_text()


def test_errors_of_the_system_are_told_and_others_are_faults_of_ours(lab: Said) -> None:
    code, out, err = lab(OSError(errno.ENOSPC, "No space left on device", "run.pansrec"))
    assert (code, out) == (2, "")
    assert err.startswith("pans: run.pansrec: No space left on device\n  remedy: make room")
    code, out, err = lab(ZeroDivisionError("of ours"))
    assert code == EXIT_INTERNAL
    assert "internal error: ZeroDivisionError: of ours (test_cli.py:" in err
    with pytest.raises(ZeroDivisionError):
        main(["lab", "--debug"])


def test_quiet_and_verbose(lab: Said) -> None:
    def run(args: argparse.Namespace) -> None:
        say("on the way")
        note("in detail")
        warn("careful")
        emit(args, {}, "answer")

    assert lab(run)[1:] == ("answer\n", "on the way\npans: warning: careful\n")
    assert lab(run, "-q")[1:] == ("answer\n", "pans: warning: careful\n")
    assert "in detail\n" in lab(run, "-v")[2]


def test_a_labs_command_may_use_a_short_option_for_itself(lab: Said) -> None:
    assert lab(lambda args: args.v, "-v 1", lambda parser: parser.add_argument("-v", type=int))[0] == 1


def test_a_slow_command_shows_that_it_began(lab: Said) -> None:
    def run(args: argparse.Namespace) -> None:
        while not printing.state.said:  # pytest's time limit is the only clock here
            threading.Event().wait(0.01)

    assert lab(run) == (0, "", "pans lab: loading ...\n")


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


def test_an_answer_with_letters_that_the_terminal_has_not_is_printed_with_escapes(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "pans", *fixed_run(3), "--out", str(tmp_path / "run"), "-q"]
    ascii_alone = os.environ | {"PYTHONIOENCODING": "ascii"}
    done = subprocess.run(words, capture_output=True, env=ascii_alone, check=True)
    assert done.stdout.startswith(b"SIMULATED \\xb7 PASS: 3 decisions (3 objects \\xd7 1 trials)")
