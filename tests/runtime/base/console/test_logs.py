"""Logs: lines of both forms, rotation, foreign files left alone, limits, priorities for the journal; and a run's events in them."""

import json
import logging
import os
import subprocess
import sys
import time
from argparse import Namespace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import Pans, fixed_run

from pans.app.main import main
from pans.base.console import logs, warn
from pans.base.console.logs import LOGGER, is_log_line, log_event, logging_of
from pans.base.errors import UsageError


def asked(path: Path | None, form: str | None = None, rotate_mb: float | None = None) -> Namespace:
    return Namespace(log_file=path, log_format=form, log_rotate_mb=rotate_mb)


def test_a_line_has_time_level_and_facts_as_text_or_as_one_object(tmp_path: Path, pans: Pans) -> None:
    with logging_of(asked(tmp_path / "pans.log")):
        warn("arming\nnow")
        log_event("gap", {"lost": 3, "why": "a\nb\x1b[2J"})
    lines = (tmp_path / "pans.log").read_text().splitlines()
    texts = [line.split(" ", 1)[1] for line in lines]
    assert texts == ["WARNING arming\\nnow", "INFO gap lost=3 why=a\\nb\\x1b[2J"]
    assert pans.said().err == "pans: warning: arming\nnow\n"
    with logging_of(asked(tmp_path / "json.log", "json")):
        log_event("gap", {"lost": np.int64(3), "rows": np.arange(2)}, logging.ERROR)
    line = json.loads(text := (tmp_path / "json.log").read_text())
    assert (line["level"], line["message"], line["facts"]) == ("ERROR", "gap", {"lost": 3, "rows": [0, 1]})
    assert all(is_log_line(line.encode()) for line in (*lines, text))


def test_a_log_goes_on_and_rotates(tmp_path: Path) -> None:
    path = tmp_path / "pans.log"
    for _ in range(2):
        with logging_of(asked(path, rotate_mb=0.01)):
            for number in range(400):
                LOGGER.info("line %d of many, with some words behind it to fill the file", number)
    names = {file.name for file in tmp_path.iterdir()}
    assert names == {"pans.log", *(f"pans.log.{number}" for number in range(1, 6))}
    assert all(file.stat().st_size <= 0.01 * logs.MIB for file in tmp_path.iterdir())
    assert "line 399 of" in path.read_text().splitlines()[-1]


@pytest.mark.parametrize("name", ["pans.log", "pans.log.3"])
@pytest.mark.parametrize("content", [b"precious\n", b'{"a": 1}\n', b"\x00\x01", b"2026-01-01 what\n", b"[" * 70000])
def test_foreign_files_stay(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UsageError, match="not a log of pans") as caught, logging_of(asked(tmp_path / "pans.log")):
        pass
    assert "--log-file" in caught.value.remedy
    assert (tmp_path / name).read_bytes() == content
    assert len(list(tmp_path.iterdir())) == 1


def test_a_fault_that_repeats_does_not_fill_the_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(logs.time, "monotonic", lambda: now[0])
    path = tmp_path / "pans.log"
    with logging_of(asked(path, "json")):
        for number in range(50):
            log_event("gap", {"number": number})
        log_event("session", {})
        now[0] = 61.0
        log_event("gap", {"number": 50})
    found = [json.loads(line) for line in path.read_text().splitlines()]
    assert [line["message"] for line in found] == ["gap"] * 20 + ["session", "gap"]
    assert found[-1]["facts"] == {"number": 50, "not_logged_before": 30}


def test_a_full_queue_and_a_full_disk_cost_lines_and_say_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pans: Pans
) -> None:
    monkeypatch.setattr(logs, "QUEUE_LINES", 5)
    emit = logs._FileHandler.emit

    def slow(handler: Any, record: logging.LogRecord) -> None:
        time.sleep(0.02)
        emit(handler, record)

    monkeypatch.setattr(logs._FileHandler, "emit", slow)
    with logging_of(asked(tmp_path / "pans.log")):
        for number in range(20):
            LOGGER.info("line %d", number)
    written = len((tmp_path / "pans.log").read_text().splitlines())
    assert written < 20
    assert f"pans: {20 - written} lines are missing" in pans.said().err

    def full(handler: Any, record: logging.LogRecord) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(logs._FileHandler, "emit", emit)
    monkeypatch.setattr(logs._FileHandler, "shouldRollover", full)
    with logging_of(asked(tmp_path / "full.log")):
        LOGGER.info("a line")
    assert "pans: 1 lines are missing" in pans.said().err


@pytest.mark.skipif(sys.platform == "win32", reason="needs the journal's environment")
def test_stderr_has_priorities_where_it_is_the_journal(tmp_path: Path) -> None:
    said = (
        "from pans.base.console import say, warn; from pans.base.console import fail; from pans.base.errors import LinkError;"
        "say('a\\nb'); warn('c'); fail(LinkError('d', remedy='e'), 3)"
    )
    events = (
        "import logging; from argparse import Namespace; from pans.base.console import log_event, logging_of\n"
        "with logging_of(Namespace(log_file=None, log_format=None, log_rotate_mb=None)):\n"
        "    log_event('gap', {'lost': 3}, logging.WARNING); log_event('session', {'nonce': 'a\\nb'})"
    )
    for code, journal, wanted in (
        (said, True, "<6>a\n<6>b\n<4>pans: warning: c\n<3>pans: d\n<3>  remedy: e\n"),
        (said, False, "a\nb\npans: warning: c\npans: d\n  remedy: e\n"),
        (events, True, "<4>pans: gap lost=3\n<6>pans: session nonce=a\\nb\n"),
    ):
        with open(tmp_path / "stderr", "w") as stderr:
            found = os.fstat(stderr.fileno())
            stream = f"{found.st_dev}:{found.st_ino}" if journal else "1:2"
            subprocess.run([sys.executable, "-c", code], stderr=stderr, env=os.environ | {"JOURNAL_STREAM": stream})
        assert (tmp_path / "stderr").read_text() == wanted


def test_a_run_logs_its_words_its_events_and_its_end(tmp_path: Path, pans: Pans) -> None:
    log = tmp_path / "run.log"
    words = [*fixed_run(5), "--out", str(tmp_path / "out"), "--log-file", str(log), "--log-format", "json"]
    code = main(words)
    found = [json.loads(line) for line in log.read_text().splitlines()]
    assert found[0]["message"].startswith("begins: pans run")
    assert found[-1]["message"] == f"ends with exit code {code}"
    assert "session" in [line["message"] for line in found]
    assert main(["verify", str(tmp_path / "none"), "--log-file", str(tmp_path / "e.log")]) == 2
    assert main(["info", str(tmp_path / "none"), "--log-file", str(tmp_path / "e.log")]) == 2
    pans.said()
    lines = (tmp_path / "e.log").read_text().splitlines()
    assert "ERROR ends by an error: UsageError: " in lines[-1]
