"""Which marks are remembered: compared with a dictionary in the order of setting, cut at the limit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pans.runtime.core import marks
from pans.runtime.core.marks import Marks
from pans.runtime.wire.messages import Mark
from pans.runtime.wire.schema import MARK_DTYPE


def rows_of(some: list[Mark]) -> np.ndarray:
    columns = ("seq", "object_index", "truth", "exposure_index", "tick", "photons", "half_exposures")
    rows = np.zeros(len(some), MARK_DTYPE)
    for name, values in zip(columns, zip(*some)):
        rows[name] = values
    return rows


@settings(max_examples=50, deadline=None)
@given(st.lists(st.one_of(st.integers(0, 9), st.lists(st.integers(0, 9), max_size=12)), max_size=20), st.booleans())
def test_the_latest_objects_are_remembered(steps: list[int | list[int]], keeps: bool) -> None:
    """One by one or many rows at once; one that comes again is as young as a new one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(marks, "MAX_MARKS", 4)
        found, expected, seq = Marks(), dict[int, Mark](), 0
        for step in steps:
            some = []
            for number in [step] if isinstance(step, int) else step:
                seq += 1
                some.append(Mark(seq, number, number - 1, 8 * seq, 10**15 + seq, 0.5 * seq, seq % 3))
                expected.pop(number, None)
                expected[number] = some[-1]
                expected = dict(list(expected.items())[-4:])
            if isinstance(step, int):
                found.add(some[0])
            elif some:
                found.add_rows(rows_of(some))
            assert [found.get(number) for number in range(10)] == [expected.get(number) for number in range(10)]
        assert (len(found), found.latest()) == (len(expected), list(expected.values()))
        if keeps:
            found.keep(2)
            assert found.latest() == list(expected.values())[-2:]
