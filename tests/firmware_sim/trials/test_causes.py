"""The judging halves of causes.py and soak.py; what they run takes minutes of real time."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from pans.firmware_sim.trials import figures_text
from pans.firmware_sim.trials.cause_processes import Injection
from pans.firmware_sim.trials.causes import DISK_HOLD_MS, KINDS, compare, make_script, report
from pans.firmware_sim.trials.soak import slope_of

MS = 1_000_000


def test_a_script_has_as_many_of_each_kind_and_room_between_them() -> None:
    script = make_script(60, 3)
    assert Counter(one.kind for one in script) == dict.fromkeys(KINDS, 10)
    assert all(later.at_ns > one.at_ns + one.length_ns + 200 * MS for one, later in pairwise(script))
    assert {one.length_ns for one in script if one.kind == "disk"} == {DISK_HOLD_MS * MS}
    assert [one.variant for one in script if one.kind == "host"] == list(range(10))
    assert make_script(60, 3) == script != make_script(60, 4)


def verdict(cause: str, begin_ms: float, end_ms: float, sure: bool = True) -> dict[str, Any]:
    return {"cause": cause, "begin_ns": int(begin_ms * MS), "end_ns": int(end_ms * MS), "sure": sure, "why": "because"}


def test_the_verdict_that_overlaps_most_is_compared() -> None:
    script = [
        Injection("link", 100 * MS, 50 * MS, 0),
        Injection("gc", 300 * MS, 40 * MS, 0),
        Injection("host", 500 * MS, 40 * MS, 1),
    ]
    verdicts = [verdict("host", 1090, 1102), verdict("link", 1100, 1150), verdict("disk", 1900, 1950)]
    compared = compare(script, 1000 * MS, verdicts, [(1310 * MS, 1320 * MS)])
    assert [entry["named"] for entry in compared] == ["link", "nothing", "nothing"]
    assert [entry["disturbed"] for entry in compared] == [False, True, False]
    result = report(compared, Counter(), {})
    assert (result["injections"], result["right"], result["disturbed"]) == (2, 1, 1)
    assert result["matrix"]["link"]["link"] == 1
    assert result["matrix"]["host"]["nothing"] == 1
    text = figures_text(result)
    assert "right 1\nshare 0.5\n" in text
    assert next(line.split() for line in text.splitlines() if line.startswith("  host ")) == [
        "host",
        "0",
        "0",
        "0",
        "0",
        "0",
        "0",
        "1",
    ]


def test_the_hog_is_no_disturbance_of_its_own_injection() -> None:
    script = [Injection("host", 0, 40 * MS, variant) for variant in (0, 1)]
    compared = compare(script, 0, [verdict("host", 0, 40)], [(0, 40 * MS)])
    assert [entry["disturbed"] for entry in compared] == [False, True]


def test_slopes() -> None:
    x = np.linspace(0, 30, 100)
    assert slope_of(x, 5 + 2 * x) == pytest.approx((2, 0), abs=1e-9)
    noise = np.random.default_rng(1).normal(size=100)
    slope, error = slope_of(x, 5 + 2 * x + noise)
    assert abs(slope - 2) < 5 * error
    assert error == pytest.approx(1 / np.sqrt(((x - 15) ** 2).sum()), rel=0.3)
    assert slope_of(x[:2], x[:2]) == (0.0, 0.0)
