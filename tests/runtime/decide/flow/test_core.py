"""Objects in flow: the same frames give the same passages however they are cut; a gap is never decided over; one decision each."""

from fractions import Fraction

import numpy as np
import pytest
from flows import PERIOD_TICKS, SESSION, SETTINGS, feed, frame, make, mark, plan_of, scene
from hypothesis import given, settings
from hypothesis import strategies as st
from naive_flow import passages as naive_passages
from numpy.typing import NDArray

from pans.base.errors import UsageError
from pans.bundle.backends import NO_LABEL
from pans.decide.decision import DecisionFlag, Output, joined
from pans.decide.flow import kernels
from pans.decide.flow.settings import flow_limits
from pans.protocol.wire import NO_OBJECT, DeviceState, StateReason
from pans.protocol.wire import messages as wire
from pans.protocol.wire.messages import FrameBlock, Status

F64 = NDArray[np.float64]


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_scan_finds_what_plain_loops_find_however_the_frames_are_cut(data: st.DataObject) -> None:
    width, hold = data.draw(st.integers(1, 6)), data.draw(st.integers(0, 5))
    on = data.draw(st.integers(1, 8))
    off, longest = data.draw(st.integers(0, on - 1)), data.draw(st.integers(width, 20))
    level = st.sampled_from([0, 0, 0, 1, 3, None])
    runs = data.draw(st.lists(st.tuples(level, st.integers(1, 12)), max_size=12))
    counts = [level for level, n in runs for _ in range(n)]
    background = Fraction(data.draw(st.integers(0, 1 << 12)), 1 << 16)
    limits = np.array([width, on, off, longest, hold, int(background * (1 << 16)), 2, 16, 0], np.int64)
    state, words, ring = np.zeros(1, kernels.RING_DTYPE), np.zeros(256, np.uint64), np.zeros(256, np.int16)
    out, found, at = np.zeros((2, kernels.N_COLUMNS), np.int64), [], 0
    empty, dark = np.zeros(64, np.int64), np.zeros(64, np.int64)
    while at < len(counts):
        size = data.draw(st.integers(1, 9))
        part = counts[at : at + size]
        if part[0] is None:
            n = next((i for i, c in enumerate(part) if c is not None), len(part))
            kernels.skip_frames(at, at + n, words, ring, state)
        else:
            n = next((i for i, c in enumerate(part) if c is None), len(part))
            rows = np.array([[(1 << (c or 0)) - 1] for c in part[:n]], np.uint8)
            kernels.put_frames(rows, at, words, ring, 0, state, dark, np.uint64(2**64 - 1))
            while state[0].next_exposure < at + n:
                m = kernels.scan(at + n, words, ring, limits, state, empty, out)
                found += out[:m].tolist()
        at += n
    wanted = naive_passages(counts, width, on, off, longest, hold, background)
    assert [(row[0], row[1], row[3], bool(row[4] & 1), bool(row[4] & 2)) for row in found] == [
        (first, last, clicks, broken, long) for first, last, _, clicks, broken, long in wanted
    ]
    for row, (first, _, centre, *_) in zip(found, wanted):
        assert row[2] / 256 == pytest.approx(first + centre, abs=0.08)
    assert dark.sum() == 0


def test_two_maxima_are_told_from_one_with_noise() -> None:
    rng = np.random.default_rng(5)
    t = np.arange(120)
    one = 5 * np.exp(-(((t - 60) / 22.0) ** 2))
    two = 5 * np.exp(-(((t - 30) / 11.0) ** 2)) + 5 * np.exp(-(((t - 90) / 11.0) ** 2))

    def found(rate: np.ndarray) -> int:
        hits = 0
        for _ in range(400):
            ring = np.zeros(128, np.int16)
            ring[:120] = rng.poisson(rate)
            hits += bool(kernels.has_two_maxima(ring, 0, 119, 6, 16))
        return hits

    assert found(one) <= 4
    assert found(two) >= 396


def test_every_cell_is_decided_once_in_its_middle() -> None:
    core = make()
    cells = ((100, 60, 0), (300, 70, 1), (500, 50, 2), (700, 60, 7))
    output = feed(core, scene(*cells))
    assert [d.label for d in output.decisions] == [0, 1, 2, 3]
    assert [d.object for d in output.decisions] == [0, 1, 2, 3]
    for (first, length, _), decision, passage in zip(cells, output.decisions, output.passages):
        assert abs(passage.centre - (first + (length - 1) / 2)) <= 1
        assert decision.exposure_index == passage.centre
        needed = -(-core.limits.onset_clicks // 2)  # frames of two clicks until the onset
        assert (passage.first, passage.last) == (first + needed - 6, first + length - 1)
        assert passage.leave_tick == 1000 + (passage.last + 1) * PERIOD_TICKS
        assert decision.tick == 1000 + (decision.exposure_index + 1) * PERIOD_TICKS
        assert passage.clicks == 2 * length + length - 2 * (length // 3)


@pytest.mark.parametrize(("again", "wrong"), [(2, {}), (3, {"truth": 1})])
def test_a_passage_that_is_marked_again_is_one_passage_and_of_one_class(again: int, wrong: dict[str, int]) -> None:
    core = make()
    feed(core, scene((100, 60, 2)), marks=(mark(0, 130, 2, 30), mark(0, 131, again, 30)))
    core.step(frame(wire.encode_status(Status(DeviceState.IDLE, StateReason.COMPLETED, 0, 0, 10**6, 1000), SESSION)))
    assert core.contradictions == wrong
    assert core.matcher.figures(1).passages["marks"] == 1


def test_a_flickering_cell_is_one_cell() -> None:
    words = scene((100, 60, 1))
    words[110:160:4] = 0  # the light flickers, the sums do not fall to the release
    assert [d.label for d in feed(make(), words).decisions] == [1]


@pytest.mark.parametrize("drop", [5, 6])
def test_a_gap_within_a_cell_or_over_its_beginning_abstains_and_the_next_cell_is_decided(drop: int) -> None:
    core = make()
    output = feed(core, scene((100, 60, 0), (300, 60, 1)), drop=(drop,))
    lost = (NO_LABEL, DecisionFlag.GAP | DecisionFlag.ABSTAINED)
    assert [(d.label, d.flags) for d in output.decisions] == [lost, (1, 0)]
    assert core.tracker.counters.lost_exposures == 20


def test_no_decided_window_ever_overlaps_a_gap() -> None:
    rng = np.random.default_rng(11)
    for _ in range(60):
        starts = np.cumsum(rng.integers(70, 200, 6))
        words = scene(*[(int(first), int(rng.integers(40, 70)), int(rng.integers(3))) for first in starts], n=1400)
        drop = tuple(rng.choice(70, int(rng.integers(1, 6)), replace=False).tolist())
        lost = {exposure for block in drop for exposure in range(20 * block, 20 * block + 20)}
        decider_before = feed(make(shots=5), words, drop=drop)
        for decision in decider_before.decisions:
            if decision.label != NO_LABEL:
                assert not lost & set(range(decision.exposure_index - 4, decision.exposure_index + 1))


def test_too_long_and_two_maxima_are_coincidences() -> None:
    longest = flow_limits(SETTINGS, plan_of(20), 1e-4).longest
    assert longest == 110
    flags = DecisionFlag.COINCIDENCE | DecisionFlag.ABSTAINED
    assert [d.flags for d in feed(make(), scene((100, 115, 0))).decisions] == [flags]
    dip = scene((100, 45, 0), (154, 45, 1))
    dip[110:135] |= 0b1111000000
    dip[165:190] |= 0b1111000000
    dip[145:154] = 0b10000  # one click per frame keeps it open
    assert [d.flags for d in feed(make(), dip).decisions] == [flags]
    stays = feed(make(), scene((100, 600, 0), (800, 60, 1)))  # light that stays is one abort and then nothing
    assert [d.flags for d in stays.decisions] == [flags, 0]


def test_ambiguous_cells_are_aborted_when_asked_for() -> None:
    output = feed(make(sure=0.5), scene((100, 60, 7)))
    assert [d.flags for d in output.decisions] == [DecisionFlag.AMBIGUOUS | DecisionFlag.ABSTAINED]


def test_pooled_windows_add_their_evidence() -> None:
    output = feed(make(pool=3, shots=2), scene((100, 60, 1)))
    (decision,) = output.decisions
    assert (decision.label, decision.clicks) == (1, 3 * 2 * 3)
    assert decision.probability > 0.999
    (middle,) = output.passages
    assert decision.exposure_index - 5 <= middle.centre <= decision.exposure_index


def test_dark_frames_are_tallied_and_never_decided_on() -> None:
    words = scene(*[(100 + 100 * i, 60, 1) for i in range(8)])
    words[19::20] = 0b1000000000  # the dark frames: only the detectors
    core = make(20, dark=True, shots=3)
    output = feed(core, words)
    assert [d.label for d in output.decisions] == [1] * 8
    for decision in output.decisions:
        assert not any(e % 20 == 19 for e in range(decision.exposure_index - 2, decision.exposure_index + 1))
    assert core.dark_channels.tolist() == [0] * 9 + [50]
    assert core.tallies.tolist() == [500, 50, 0, 0]


def test_frames_without_an_object_are_tallied_per_channel() -> None:
    words = scene((500, 60, 1))
    words[20] = words[450] = words[600] = 1 << 8  # too near to the start, to the cell's light, and after it
    words[120:440:32] |= 1 << 8
    core = make()
    feed(core, words)
    assert core.empty_channels.tolist() == [0] * 8 + [10, 0]
    # the onset is at 501, the release at 565, 55 frames are kept off
    assert core.empty_frames == (445 - 56 + 1) + (944 - 620 + 1)


def test_pulses_are_asked_for_at_a_tick_after_leaving() -> None:
    core = make(gate_classes=("b",), gate_delay_us=900.0, gate_us=50.0, gate_channel=3)
    output = feed(core, scene((100, 60, 0), (300, 60, 1)))
    (action,) = output.actions
    assert (action.number, action.duration_ticks, action.channel) == (1, 5000, 3)
    assert action.tick == output.passages[1].leave_tick + 90_000


def test_the_end_of_the_plan_settles_an_open_cell() -> None:
    core = make(n_cycles=10)
    output = feed(core, scene((160, 60, 0), n=200))
    assert not output.decisions
    done = Status(DeviceState.IDLE, StateReason.COMPLETED, 0, 0, 10**6, 200)
    settled = core.step(frame(wire.encode_status(done, SESSION)))
    assert [d.flags for d in settled.decisions] == [DecisionFlag.INCOMPLETE | DecisionFlag.ABSTAINED]
    assert core.completed
    assert not core.end().decisions


def test_a_second_stream_goes_on_with_the_numbers() -> None:
    core = make(n_cycles=100)
    feed(core, scene((100, 60, 0), n=400))
    assert core.cycles_left(100) == 80
    core.begin(1000, 80)
    output = feed(core, scene((100, 60, 1), n=400))
    assert [(d.number, d.object, d.label) for d in output.decisions] == [(1, 1, 1)]
    assert core.cycles_left(100) == 60


@pytest.mark.parametrize(("kind", "track"), [("cells", 0), ("tape", 0), ("tape", 3)])
def test_a_core_that_goes_on_from_a_part_gives_the_same_rows(kind: str, track: int) -> None:
    words = scene((100, 60, 0), (300, 60, 1), (505, 60, 2), n=800)
    changes = {"kind": kind, "bars_per_s": 20_000.0, "track": track}
    whole = feed(make(**changes), words)
    first = make(**changes)
    before = feed(first, words[:500])
    place = first.part()
    assert place is not None
    second = make(**changes)
    second.resume(place)
    after = Output([], [], None)
    for start in range(500, 800, 20):
        rows = np.ascontiguousarray(words[start : start + 20].astype("<u2")).view(np.uint8).reshape(-1, 2)
        seq = second.tracker.next_seq
        block = FrameBlock(seq, 0, 1000 + start * PERIOD_TICKS, start, PERIOD_TICKS, NO_OBJECT, rows)
        after = joined(after, second.step(frame(wire.encode_frames(block, SESSION))))
    assert before.decisions + after.decisions == whole.decisions


def test_bars_are_decided_where_the_speed_says() -> None:
    """A bar every 25 frames, position 0 at 31 us: frame 15 is the one around it."""
    words = np.zeros(500, np.uint16)
    for position in range(20):
        words[15 + 25 * position] = 1 << (position % 3)
    core = make(kind="tape", bars_per_s=20_000.0, first_bar=31.0 / 50)
    output = feed(core, words)
    assert [d.exposure_index for d in output.decisions] == [15 + 25 * n for n in range(20)]
    assert [d.label for d in output.decisions] == [n % 3 for n in range(20)]
    assert [p.clicks for p in output.passages] == [1] * 20


def test_bars_in_a_gap_abstain() -> None:
    words = np.full(500, 1, np.uint16)
    output = feed(make(kind="tape", bars_per_s=20_000.0, first_bar=31.0 / 50), words, drop=(3,))
    assert [d.flags for d in output.decisions][1:4] == [0, DecisionFlag.GAP | DecisionFlag.ABSTAINED, 0]
    assert len(output.decisions) == 20


def test_alignment_does_not_drift_over_a_million_bars() -> None:
    core = make(kind="tape", bars_per_s=20_000.0 / 1.0001, first_bar=31.0 / 50.005)
    middle = core._origin + 10**6 * core._nominal_pitch
    assert core.window_of(middle) == round(15 + 25.0025 * 10**6)


def moving_tape(edges_at: F64, bars: F64, n: int, seed: int, light: float = 8.0) -> NDArray[np.uint16]:
    """Frames of three channels, channel i showing bar m + i from edge m to edge m + 1 (in frames); mixed frames click by their light."""
    rng = np.random.default_rng(seed)
    fine = 16
    moments = (np.arange(n * fine) + 0.5) / fine
    window = np.searchsorted(edges_at, moments, "right") - 1
    words = np.zeros(n, np.uint16)
    for channel in range(3):
        share = bars[np.maximum(window, 0) + channel].reshape(n, fine).mean(axis=1)
        words |= (rng.random(n) < 1 - np.exp(-light * share)).astype(np.uint16) << channel
    return words


@pytest.mark.parametrize("off", [-0.02, -0.01, 0.0, 0.01, 0.02])
def test_a_tape_of_another_speed_is_followed(off: float) -> None:
    """Windows must stay within the bars, to the end, and the speed must be found; without following they run away."""
    rng = np.random.default_rng(5)
    n, pitch = 20_000, 25.0 * (1 - off)
    edges = 15.5 + pitch * (np.arange(n // 20) - 0.5)
    words = moving_tape(edges, rng.integers(0, 2, n).astype(np.float64), n, 6)
    cores = {track: make(kind="tape", bars_per_s=20_000.0, first_bar=31.0 / 50, track=track) for track in (0, 3)}
    for track, core in cores.items():
        rows = feed(core, words).decisions
        middles = np.array([row.exposure_index + 0.5 for row in rows])
        numbers = np.arange(len(middles))
        beside = (middles - 15.5) / pitch - numbers  # in bars, from where bar `number` is aligned
        if track:
            assert np.abs(beside[len(beside) // 2 :]).max() < 0.1
            assert np.abs(beside).max() < 0.4
            assert core.bars_per_s == pytest.approx(20_000.0 / (1 - off), rel=0.004)
        elif off:
            assert np.abs(beside).max() > 2.0


def test_a_tape_that_changes_its_speed_is_followed() -> None:
    rng = np.random.default_rng(7)
    pitches = 25.0 * (1 + 0.03 * np.sin(np.arange(1600) / 120.0))
    edges = 15.5 - 12.5 + np.concatenate([[0.0], np.cumsum(pitches)])
    n = int(edges[-2])
    words = moving_tape(edges, rng.integers(0, 2, 2000).astype(np.float64), n, 8)
    core = make(kind="tape", bars_per_s=20_000.0, first_bar=31.0 / 50, track=3)
    middles = np.array([row.exposure_index + 0.5 for row in feed(core, words).decisions])
    centres = (edges[:-1] + edges[1:]) / 2
    assert len(middles) > 1500
    assert (np.abs(middles - centres[: len(middles)]) / 25.0)[50:].max() < 0.4  # of a bar, with three channels to tell


def test_edges_are_counted_as_in_plain_loops() -> None:
    rng = np.random.default_rng(9)
    out = np.zeros(kernels.N_EDGES, np.int64)
    for _ in range(50):
        words, counts = rng.integers(0, 1 << 12, 32).astype(np.uint64), rng.integers(-2, 4, 32).astype(np.int16)
        before, frames, between = int(rng.integers(100)), int(rng.integers(1, 4)), int(rng.integers(0, 6))
        start = before + frames + between
        kernels.count_edges(words, counts, before, start, frames, out)
        at = [int(words[e % 32]) for e in range(before, start + frames)]
        first, then = at[:frames], at[-frames:]
        wanted = [0, 0, 0, 0, sum(int(counts[e % 32]) < 0 for e in range(before, start + frames))]
        for bit in range(12):
            was, comes = any(w >> bit & 1 for w in first), any(w >> bit & 1 for w in then)
            lit = sum(w >> bit & 1 for w in at[frames : frames + between])
            if was != comes:
                wanted[0 if comes else 1] += 1
                wanted[2 if comes else 3] += lit
        assert out.tolist() == wanted


def test_nothing_is_learnt_over_a_gap() -> None:
    """The loop goes through a gap as if nothing had been, and is locked behind it."""
    rng = np.random.default_rng(10)
    edges = 15.5 + 24.8 * (np.arange(900) - 0.5)
    words = moving_tape(edges, rng.integers(0, 2, 1000).astype(np.float64), 20_000, 11)
    whole = make(kind="tape", bars_per_s=20_000.0, first_bar=31.0 / 50, track=3)
    output = feed(whole, words, drop=(100, 101))
    beside = (np.array([row.exposure_index + 0.5 for row in output.decisions]) - 15.5) / 24.8
    off = beside - np.arange(len(beside))
    assert np.abs(off[300:]).max() < 0.1
    assert any(row.flags & DecisionFlag.GAP for row in output.decisions)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gate_classes": ("x",)}, "gate class x, allowed: a, b, c, null"),
        ({"background": 0.9}, "no onset level keeps"),
        ({"kind": "tape", "bars_per_s": 1e6}, "a bar passes in 0.5 frames, a decision takes 1"),
        ({"fields_per_s": 0.5}, "an object takes"),
    ],
)
def test_what_cannot_be_done_is_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        make(**changes)  # type: ignore[arg-type]
