"""The first start: another process compiles once, is waited for, is ended when the run fails; nothing is done where nothing can be kept."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from pans.runtime.operate import first_start
from pans.runtime.operate.first_start import compiled_beside
from pans.runtime.operate.warm import Job

Started = list[subprocess.Popen[str]]


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Started:
    processes: Started = []

    def start(job: Job) -> subprocess.Popen[str]:
        process = subprocess.Popen([sys.executable, "-S", "-c", CODE[0]], stderr=subprocess.PIPE, text=True)
        processes.append(process)
        return process

    monkeypatch.setattr(first_start, "start", start)
    monkeypatch.setattr(first_start, "JOBS", {first_start.BESIDE: lambda: None})
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    CODE[0] = "pass"
    return processes


CODE = ["pass"]


def stamps(tmp_path: Path) -> list[str]:
    return [path.name for path in (tmp_path / "cache").iterdir()]


def test_it_compiles_beside_the_first_run_and_not_beside_the_next(started: Started, tmp_path: Path) -> None:
    for _ in range(2):
        with compiled_beside() as wait:
            wait()
    assert [process.poll() for process in started] == [0]
    assert len(stamps(tmp_path)) == 1


def test_other_sources_are_compiled_again(started: Started, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for packages in (("core",), ("core", "wire")):
        monkeypatch.setattr(first_start, "PACKAGES", packages)
        with compiled_beside() as wait:
            wait()
    assert len(started) == 2
    assert len(stamps(tmp_path)) == 1


def test_a_process_that_failed_is_tried_again(started: Started, tmp_path: Path) -> None:
    CODE[0] = "raise SystemExit(1)"
    for _ in range(2):
        with compiled_beside() as wait:
            wait()
    assert len(started) == 2
    assert stamps(tmp_path) == []


def test_a_run_that_fails_before_leaves_no_process(started: Started, tmp_path: Path) -> None:
    CODE[0] = "import time; time.sleep(60)"
    with pytest.raises(RuntimeError), compiled_beside():
        raise RuntimeError
    (process,) = started
    assert process.poll() is not None
    assert stamps(tmp_path) == []


def test_where_nothing_can_be_kept_nothing_is_done(
    started: Started, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "cache"))
    with compiled_beside() as wait:
        wait()
    assert started == []
