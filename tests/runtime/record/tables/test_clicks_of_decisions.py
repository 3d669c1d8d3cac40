"""The decision of each click, of runs whose device was lost and found again: its clock may have begun anew."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from plans import shot_major

from pans.bundle.backends import Decider, Verdict
from pans.decide import DECISION_DTYPE
from pans.decide.still import Core
from pans.protocol.wire import unpack_body
from pans.protocol.wire.framing import FrameDecoder, pack_body
from pans.protocol.wire.messages import ClickBlock, encode_clicks
from pans.record.reading.exposures import ClickList, click_list
from pans.record.tables.tables import click_table

N, VISITS = 5, 4
PLAN = shot_major(N, 2)  # two decisions of one shot each in a visit
CYCLE = PLAN.slots_per_cycle
LONG_AGO = 1_000_000
# Of each stream: the tick at which it starts, and its blocks, half a cycle each. The second shows a dark slot alone and decides on nothing;
# the third is cut off within a window; the last one repeats the ticks of the first and loses a whole visit.
STREAMS = [
    (LONG_AGO, range(4 * VISITS)),
    (0, []),
    (0, range(7)),
    (LONG_AGO, [0, 1, 2, 3, 9, 10, 11]),
]


class Silent(Decider):
    """A back end that knows one class."""

    name, n_features, n_classes = "silent", N, 1

    def decide(self, counts: np.ndarray, shots: int) -> Verdict:
        return Verdict(0, 1.0)


def run_of(streams: list[tuple[int, Any]]) -> tuple[Any, np.ndarray]:
    """Return what `click_list` and `click_table` ask of a recording, and its decisions, as a core makes them."""
    core, bodies, decisions, rng = Core(PLAN, Silent(), 1, 2 * VISITS), [], [], np.random.default_rng(4)
    for session, (start, blocks) in enumerate(streams, 1):
        decisions += core.begin(start, 2 * VISITS).decisions
        pieces = [(half * CYCLE // 2, CYCLE // 2) for half in blocks] or [(0, 1)]
        for seq, (first, count) in enumerate(pieces):
            shown = PLAN.slot_pattern[(first + np.arange(count)) % CYCLE]
            head = (seq, 0, start + 100 * first, first, 100, first // (2 * CYCLE))
            block = ClickBlock(*head, shown, rng.integers(0, 2, count, np.uint8))
            (frame,) = FrameDecoder().feed(encode_clicks(block, session))
            bodies.append(pack_body(frame))
            decisions += core.step(unpack_body(bodies[-1])).decisions
    rows = np.array(decisions + core.end().decisions, DECISION_DTYPE)
    return SimpleNamespace(
        header={"config": {"shots": 1, "tick_hz": 10**6}}, path="run", messages=lambda: ((0, body) for body in bodies)
    ), rows


def clicks_of(recording: Any, clicks: ClickList, rows: np.ndarray) -> list[int]:
    """Return the clicks of each decision, added up from the table of clicks."""
    recording.iter_decisions = lambda: iter([rows])
    of = click_table(recording, PLAN, clicks)["decision"].compressed()
    return np.bincount(of - int(rows["index"][0]), minlength=len(rows)).tolist()


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (2, 3, 0), (1, 1, 2, 0), (3, 2, 2, 2)])
def test_each_click_has_the_decision_of_its_own_stream(order: tuple[int, ...]) -> None:
    recording, rows = run_of([STREAMS[at] for at in order])
    clicks = click_list(recording, PLAN)
    assert clicks.lit_streams.tolist() == [at for at, kind in enumerate(order) if kind != 1]
    assert np.count_nonzero(rows["exposure_index"] == rows["exposure_index"][0]) == len(clicks.lit_streams)
    assert rows["clicks"].sum() > 0
    assert clicks_of(recording, clicks, rows) == rows["clicks"].tolist()


def test_a_file_that_was_cut_off_has_clicks_without_a_decision() -> None:
    recording, rows = run_of(STREAMS)
    clicks = click_list(recording, PLAN)
    for left in (0, 1, 2 * VISITS, 2 * VISITS + 2):
        recording.iter_decisions = lambda left=left: iter([rows[:left]])
        of = click_table(recording, PLAN, clicks)["decision"].compressed()
        assert np.bincount(of, minlength=left).tolist() == rows["clicks"][:left].tolist()


def test_a_later_part_may_begin_with_decisions_of_a_stream_that_sent_nothing_more() -> None:
    recording, rows = run_of(STREAMS[2:])
    clicks = click_list(recording, PLAN)
    later = clicks._replace(stream=clicks.stream + 1, lit_streams=clicks.lit_streams + 1)
    rows["index"] += 100
    left_open = rows[:1].copy()  # the second decision of a visit whose first one stands in the part before
    left_open["index"], left_open["exposure_index"], left_open["shot"], left_open["clicks"] = 99, 20 * CYCLE - 1, 1, 0
    rows = np.concatenate([left_open, rows])
    assert clicks_of(recording, later, rows) == rows["clicks"].tolist()
