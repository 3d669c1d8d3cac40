"""`pans doctor --warm`: its jobs compile what a run calls, processes run side by side, and one that fails is told."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from pans.runtime.cli import main
from pans.runtime.errors import PansError
from pans.runtime.operate.warm import JOBS, Job, _carried_out, _compiled, words_of

WATCHED = (
    "pans.runtime.record",
    "pans.runtime.instrument",
    "pans.runtime.decide",
    "pans.runtime.wire",
    "pans.runtime.turn",
)


def test_a_run_compiles_nothing_that_the_jobs_have_not_compiled(tmp_path: Path) -> None:
    from numba.core import event

    for job in JOBS.values():
        job()
    late: list[str] = []

    class Listener(event.Listener):  # type: ignore[misc]
        def on_start(self, event: Any) -> None:
            late.append(event.data["dispatcher"].py_func.__module__)

        def on_end(self, event: Any) -> None:
            pass

    listener = Listener()
    event.register("numba:compile", listener)
    try:
        for number, words in enumerate((["demo", "--pace", "fast", "--trials", "1", "--seconds", "0.1"], run_words())):
            assert main([*words, "--no-realtime", "--json", "--out", str(tmp_path / str(number))]) in (0, 1, 4)
    finally:
        event.unregister("numba:compile", listener)
    assert [module for module in late if module.startswith(WATCHED)] == []


def run_words() -> list[str]:
    return ["run", "fashion10", "--device", "sim:oled-qcmos?pace=fast&scene=fashion200", "--decisions", "3"]


def test_processes_run_side_by_side_and_a_failure_is_told(tmp_path: Path) -> None:
    wait = "import pathlib, sys, time\npathlib.Path(sys.argv[1]).touch()\nwhile not pathlib.Path(sys.argv[2]).exists(): time.sleep(0.01)"
    here, there = str(tmp_path / "a"), str(tmp_path / "b")
    jobs = [
        Job("one", ("-c", wait, here, there)),
        Job("other", ("-c", wait, there, here)),
        Job("broken", ("-c", "import sys; sys.exit('no such kernel')")),
    ]
    rows = {row["name"]: row for row in _carried_out(jobs, 2)}
    assert rows["one"]["ok"]
    assert rows["other"]["ok"]
    assert not rows["broken"]["ok"]
    found = {"kernels": 1, "seconds": 1.0, "processes": 2, "folder": "f", "jobs": [rows["one"], rows["broken"]]}
    assert "FAILED: broken: no such kernel" in words_of(found)


def test_a_job_that_hangs_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pans.runtime.operate.warm.PATIENCE_S", 0.2)
    began = time.monotonic()
    with pytest.raises(PansError, match="slow: not compiled within"):
        list(_carried_out([Job("slow", ("-c", "import time; time.sleep(60)"))], 1))
    assert time.monotonic() - began < 30, "it waited for the process"


def test_what_is_compiled_is_counted_in_the_cache(tmp_path: Path) -> None:
    (tmp_path / "core_1").mkdir()
    (tmp_path / "core_1" / "kernels.walk-1.py311.1.nbc").touch()
    (tmp_path / "core_1" / "kernels.walk-1.py311.nbi").touch()
    assert len(_compiled(tmp_path)) == 1
