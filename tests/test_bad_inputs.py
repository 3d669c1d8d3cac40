"""A list of bad inputs, made from the parsers of all commands: no traceback, no file lost or new, the right exit code, a remedy."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from types import FrameType

import pytest
from bad_inputs import GOOD, Case, cases, write_inputs

from pans.runtime import SHIPPED
from pans.runtime.cli import main
from pans.runtime.cli.finding import find_commands

CASES = cases()
LIMIT_S = 60  # only against waiting for ever: a busy machine may take its time


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    for slow in (
        "torch",
        "optuna",
        "pans.trainer.train.loop",
    ):  # loaded before the limit counts, where they are installed
        with suppress(ModuleNotFoundError):
            import_module(slow)
    folder = tmp_path_factory.mktemp("bad")
    words = ["run", str(SHIPPED / "fashion10.pans"), "--device", "sim:oled-qcmos?pace=fast", "--decisions", "3"]
    assert main([*words, "--record", str(folder / "made.pansrec")]) == 0
    write_inputs(folder, folder / "made.pansrec", SHIPPED / "fashion10.pans")
    return folder


def contents(folder: Path) -> dict[str, tuple[int, ...]]:
    """What tells whether anything has changed."""
    found = {}
    for place, names, files in os.walk(folder):
        for name in (*names, *files):
            path = os.path.join(place, name)
            facts = os.lstat(path)
            found[path] = (facts.st_ino, facts.st_size, facts.st_mtime_ns if name in files else 0)
    return found


@pytest.fixture
def limited() -> Iterator[None]:
    """End what waits for ever, for example on a FIFO."""

    def ring(signum: int, frame: FrameType | None) -> None:
        raise AssertionError(f"no answer within {LIMIT_S} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(LIMIT_S)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture(scope="module")
def busy() -> Iterator[str]:
    """The address of a port that somebody else has."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        yield f"tcp:127.0.0.1:{taken.getsockname()[1]}"


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_a_bad_input_is_refused(
    case: Case,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    limited: None,
    busy: str,
) -> None:
    monkeypatch.chdir(folder)
    before = contents(folder)
    words = [
        word.replace("BUSY", busy if case.words[0] == "simulate" else busy.removeprefix("tcp:")) for word in case.words
    ]
    try:
        code = main(words)
    except SystemExit as end:
        code = int(end.code or 0)
    out, err = capfd.readouterr()
    assert contents(folder) == before
    assert "Traceback" not in err
    assert code in case.codes, err
    assert (out + err).count("remedy: ") == 1, err
    assert "explains the options" not in err or "allowed" in err or "must be" in err, err


def test_there_are_200_and_every_command_is_among_them() -> None:
    assert len({case.words for case in CASES}) == len(CASES) >= 200
    assert {*GOOD} <= {*find_commands()} <= {case.words[0] for case in CASES if case.words}
