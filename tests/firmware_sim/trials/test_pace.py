"""Trials at real pace: the bars, and a second of decisions against the reference instrument, beside its probes."""

from __future__ import annotations

import os
import shutil
from typing import Any

import pytest

from pans.firmware_sim.trials.pace import (
    Settings,
    demo_broken,
    objects_broken,
    objects_rows,
    row_words,
    run,
    walk_broken,
)
from pans.runtime.errors import UsageError

HAS_FIFO = hasattr(os, "sched_setscheduler") and len(os.sched_getaffinity(0)) > 1 and os.geteuid() == 0
OBJECTS = {"decisions": 100_000, "unexplained": 1, "late_share": 1e-5, "missed": 0.002}
HOST = {"drive": "host", "late_slots_share": 1e-4, "late": 7, "lost": 0}


@pytest.mark.parametrize(
    ("judge", "row", "broken"),
    [
        (objects_broken, OBJECTS, ()),
        (objects_broken, OBJECTS | {"unexplained": 2}, ("2 of 100000 late",)),
        (objects_broken, OBJECTS | {"late_share": 2e-4}, ("late 0.0002",)),
        (objects_broken, OBJECTS | {"late_share": 2e-4, "unexplained": 0}, ()),
        (objects_broken, OBJECTS | {"missed": 0.003}, ("missed 0.003",)),
        (demo_broken, {"late": 5, "unexplained": 0}, ()),
        (demo_broken, {"late": 5, "unexplained": 2}, ("2 of 5 late",)),
        (walk_broken, HOST, ()),
        (walk_broken, HOST | {"late_slots_share": 2e-4}, ("late slots 0.0002",)),
        (walk_broken, HOST | {"drive": "device"}, ("7 late decisions",)),
        (walk_broken, HOST | {"lost": 3}, ("3 exposures lost",)),
    ],
)
def test_each_bar_that_is_missed_is_said(judge: Any, row: dict[str, Any], broken: tuple[str, ...]) -> None:
    found = judge(row)
    assert len(found) == len(broken)
    assert all(text.startswith(begin) for text, begin in zip(found, broken))


def test_without_two_cores_it_says_what_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pans.firmware_sim.trials.pace.has_real_time", lambda: False)
    with pytest.raises(UsageError, match="two cores"):
        run(Settings())


@pytest.mark.skipif(not HAS_FIFO, reason="needs Linux, two cores and the right to SCHED_FIFO")
@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_a_second_of_decisions_against_the_reference_instrument() -> None:
    cores = sorted(os.sched_getaffinity(0))[:2]
    (row,) = objects_rows(Settings(seconds=1.0, pin=(cores[0], cores[1])), ("tcp",))
    assert row["decisions"] > 900
    assert row["late"] == sum(row["whose"].values())
    assert {gaps["core"] for gaps in row["gaps"]} == set(cores)
    assert 0.6 < row["accuracy"] < 0.9, "the light is that of the shipped bundle"
    assert set(row["page_faults"]) == {"minor", "major", "involuntary_switches"}
    assert row["name"] in row_words(row)
