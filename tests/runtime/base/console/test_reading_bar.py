"""The bar over long files: on a terminal alone, one pass at a time, and gone when the pass is over."""

import io
import sys
from pathlib import Path

import pytest
from commands import Pans, fixed_run

from pans.app.main import main
from pans.base.console import progress as module
from pans.base.console.progress import ReadingBar


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def terminal(monkeypatch: pytest.MonkeyPatch) -> tuple[Terminal, ReadingBar, list[float]]:
    """Let standard error be a terminal, in a test itself, since pytest puts its own back after the fixtures; a bar, and its clock."""
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setattr(sys, "stderr", shown := Terminal())
    now_s = [100.0]
    return shown, ReadingBar(lambda: now_s[0]), now_s


def test_a_short_pass_shows_nothing_and_a_long_one_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    screen, bar, now_s = terminal(monkeypatch)
    bar.passed("/lab/short.pansrec", 1, 5, 10)
    bar.passed("/lab/short.pansrec", 1, 10, 10)
    bar.passed("/lab/[long].pansrec", 2, 1_000_000, 4_000_000)
    assert screen.getvalue() == ""
    now_s[0] += 1.5
    bar.passed("/lab/[long].pansrec", 2, 2_000_000, 4_000_000)
    bar.close()
    assert "reading [long].pansrec" in screen.getvalue()
    assert "50%" in screen.getvalue()


def test_of_two_passes_one_is_shown_until_nothing_is_heard_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    screen, bar, now_s = terminal(monkeypatch)
    for number in (1, 2):
        bar.passed(f"/lab/{number}.pansrec", number, 1, 9)
    for later_s, number in ((1.5, 2), (0.3, 1), (0.3, 2)):
        now_s[0] += later_s
        bar.passed(f"/lab/{number}.pansrec", number, 2, 9)
    assert "2.pansrec" in screen.getvalue()
    assert "1.pansrec" not in screen.getvalue()
    now_s[0] += 1.5
    bar.passed("/lab/1.pansrec", 1, 3, 9)
    bar.close()
    assert "1.pansrec" in screen.getvalue()


def test_a_replay_shows_how_far_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pans: Pans) -> None:
    screen, path = terminal(monkeypatch)[0], tmp_path / "run.pansrec"
    assert main([*fixed_run(3), "--record", str(path), "--quiet"]) == 0
    monkeypatch.setattr(module, "SHOWN_AFTER_S", 0.0)
    monkeypatch.setattr(module, "DRAWN_EVERY_S", 0.0)
    assert main(["replay", str(path), "--quiet"]) == 0
    assert "reading" not in screen.getvalue()
    assert main(["replay", str(path)]) == 0
    assert "reading run.pansrec" in screen.getvalue()
    assert "identical" in pans.said().out
