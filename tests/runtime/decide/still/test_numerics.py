"""The hard numerical cases of the runtime against mpmath and exact rationals, with the worst error that is allowed.

Click probabilities have theirs in instrument/test_click_law.py, intervals in test_intervals.py, rounding of the heads in
decide/test_mlp.py, folding of dead channels in trainer/export/test_writer.py.
"""

import numpy as np
import pytest
from heads import head_bundle, random_layers
from plans import parallel

from pans.bundle.backends.choose import make_decider
from pans.bundle.backends.int8 import winner
from pans.bundle.backends.verdict import log_evidence, softmax_winner, softmax_winners
from pans.decide.decision import DECISION_DTYPE
from pans.decide.kernel.stream_core import StreamCore
from pans.decide.still.core import Core
from pans.protocol.wire import messages as wire
from pans.protocol.wire.framing import FrameDecoder
from pans.protocol.wire.messages import FrameBlock

mpmath = pytest.importorskip("mpmath", reason="needs the test extra")


def test_winning_probabilities() -> None:
    """Worst relative error 4 units in the last place of float64, for scores of 1e-8 to 1e30 and ties."""
    rng = np.random.default_rng(1)
    scores = np.concatenate([rng.normal(size=(40, 10)) * 10.0**scale for scale in (-8, 0, 1, 2.5, 4, 30)]).astype(
        np.float32
    )
    scores = np.concatenate([scores, np.zeros((1, 10), np.float32), np.full((1, 10), -3e38, np.float32)])
    worst = 0.0
    bulk = softmax_winners(scores)
    for number, row in enumerate(scores):
        with mpmath.workdps(50):
            top = mpmath.mpf(float(row.max()))
            exact = 1 / mpmath.fsum(mpmath.exp(mpmath.mpf(float(s)) - top) for s in row)
        for label, probability in (softmax_winner(row), winner(row[None], 0, 10)):
            assert label == int(row.argmax())
            worst = max(worst, float(abs(mpmath.mpf(probability) - exact) / exact))
        assert bulk.labels[number] == row.argmax()
        assert bulk.probabilities[number] == pytest.approx(float(exact), rel=2**-23)
    assert worst <= 4 * 2**-52


@pytest.mark.parametrize(
    ("scores", "probability"),
    [([np.nan, 1], 0), ([1, np.nan], 0), ([np.inf, 0], 0), ([-np.inf, -np.inf], 0), ([-np.inf, 2], 1)],
)
def test_scores_that_are_not_finite(scores: list[float], probability: float) -> None:
    """An infinitely unlikely class is no fault."""
    row = np.array(scores, np.float32)
    bulk = softmax_winners(row[None])
    for label, found in (softmax_winner(row), winner(row[None], 0, 2), (bulk.labels[0], bulk.probabilities[0])):
        assert found == probability
        assert label == 1 or not probability


def test_counters_and_ticks_far_beyond_32_bits() -> None:
    """Exposures past 2^44, ticks past 2^61, decisions past 2^33: Core and the streaming core write the same rows."""
    plan, n_features = parallel(10, 8), 10
    decider = make_decider(head_bundle(random_layers([10, 8, 4])))
    visit = 2**41 - 513  # its object is number 2^32 - 2, the last one that there is
    first = plan.slots_per_cycle * visit
    rng = np.random.default_rng(2)
    streamed, core = StreamCore(plan, decider, 1, 0, 7), Core(plan, decider, 1, 0)
    for one in (streamed.core, core):
        one.tracker.next_exposure = first
        one.n_decisions = 2**33 - 3
        one.windows.position = (visit, 0, 0)
        one.windows.tallies[:] = 2**40
    words = rng.integers(0, 4, (9, 2)).astype(np.uint8)
    data = wire.encode_frames(FrameBlock(0, 0, 2**61, first, 100, 2**32 - 2, words), 7)
    rows = np.concatenate([batch.rows.copy() for batch in streamed.feed(data)])
    expected = core.step(FrameDecoder().feed(data)[0]).decisions
    assert rows.tolist() == np.array([tuple(row) for row in expected], DECISION_DTYPE).tolist()
    assert rows["index"].tolist() == list(range(2**33 - 3, 2**33 + 5))
    assert int(rows["exposure_index"][-1]) == first + 8
    assert int(rows["tick"][-1]) == 2**61 + 8 * 100 + plan.exposure_ticks
    assert streamed.core.windows.tallies.tolist() == core.windows.tallies.tolist()
    assert streamed.core.windows.tallies[0] == 2**40 + n_features


@pytest.mark.parametrize("floor", [1e-6, 1e-30])
def test_evidence_against_a_class_is_bounded(floor: float) -> None:
    """So that no single decision excludes a class whatever others say."""
    scores = np.array([[0.0, 3.0, 1000.0]], np.float32)
    assert log_evidence(scores, floor).tolist() == [[np.log(floor), np.log(floor), 0.0]]
    assert log_evidence(scores).min() == np.log(1e-6)


def test_log_evidence_against_mpmath() -> None:
    """Worst error over scores up to 700 apart: 2 units in the last place of the largest logarithm."""
    rng = np.random.default_rng(1)
    scores = np.concatenate([rng.normal(size=(50, 10)) * scale for scale in (1e-8, 1.0, 30.0, 300.0)])
    found = log_evidence(scores, floor=1e-300)
    worst = 0.0
    with mpmath.workdps(60):
        for row, logs in zip(scores, found):
            total = mpmath.log(sum(mpmath.exp(mpmath.mpf(float(s))) for s in row))
            for score, log in zip(row, logs):
                exact = max(mpmath.mpf(float(score)) - total, mpmath.log(mpmath.mpf(10) ** -300))
                worst = max(worst, float(abs(exact - mpmath.mpf(float(log))) / max(1, abs(exact))))
    assert worst <= 4.5e-16
