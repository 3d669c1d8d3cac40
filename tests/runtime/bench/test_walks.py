"""The benchmarks of walks compare what they measure with the plain core, and would tell a difference."""

from __future__ import annotations

import numpy as np
from automata import automaton_bundle, random_automaton

from pans.runtime.bench import walks
from pans.runtime.bench.walks import decide_rows, stream_rows
from pans.runtime.core.decision import DECISION_DTYPE


def test_every_row_has_its_check() -> None:
    bundle = automaton_bundle(random_automaton(3))
    rows = decide_rows(bundle, quick=True) + stream_rows(bundle, quick=True)
    assert len(rows) == 4
    assert [row["changed_percent"] for row in rows] == [0.0] * 4
    assert rows[0]["score_error"] == 0.0


def test_a_decision_that_differs_is_told() -> None:
    wanted = np.zeros(4, DECISION_DTYPE)
    found = wanted.copy()
    found["label"][1] = 1
    assert walks._differ([found], wanted) == 25.0
    assert walks._differ([wanted[:2], wanted[2:]], wanted) == 0.0
    assert walks._differ([wanted[:3]], wanted) == 100.0
