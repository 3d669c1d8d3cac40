"""Dead channels found in the light: stated false alarms, what is soon and what is sure, other scenes, whole runs."""

from pathlib import Path

import numpy as np
import pytest
from commands import Pans
from numpy.typing import NDArray
from plans import parallel, shot_major
from tree import ROOT

from pans.decide.dark.cusum import ChannelWatch
from pans.decide.dark.guard import DarkGuard
from pans.decide.dark.health import DeadChannelTest, silence_limit
from pans.protocol.wire import DARK_PATTERN, NO_OBJECT
from pans.protocol.wire.messages import ClickBlock, FrameBlock

F64 = NDArray[np.float64]
N = 6
# two kinds of objects: what a channel does tells something about the others, as in a real scene
SHARES = np.array([[0.7, 0.6, 0.1, 0.5, 0.2, 0.4], [0.1, 0.3, 0.6, 0.2, 0.7, 0.4]])


def objects(seed: int, n: int, shares: F64 = SHARES) -> NDArray[np.int64]:
    rng = np.random.default_rng(seed)
    return (rng.random((n, shares.shape[1])) < shares[rng.integers(len(shares), size=n)]).astype(np.int64)


def watched(
    rows: NDArray[np.int64], arl: float = 1e6, dark: float = 1e-9
) -> tuple[DeadChannelTest, list[tuple[int, int]]]:
    """Follow objects of one exposure each; return the watch and (object, channel) of what was found dead."""
    watch = DeadChannelTest(np.full(rows.shape[1], dark), 1e12, arl)
    words = np.packbits(rows.astype(np.uint8), axis=1, bitorder="little")
    found = []
    for number, row in enumerate(rows):
        watch.take_exposures(words[number : number + 1])
        watch.take_objects(row[None] > 0, np.array([-1]))
        found += [(number, one.channel) for one in watch.look()]
        watch.returned()
    return watch, found


def test_a_silence_is_as_long_as_its_false_alarms_ask_for() -> None:
    for rate, n, arl in ((1e-4, 8, 1e9), (0.3, 10, 1e7), (0.01, 1, 1e6)):
        limit = silence_limit(rate, n, arl)
        assert n * rate * (1 - rate) ** limit * arl <= 1.0
        assert n * rate * (1 - rate) ** (limit - 1) * arl > 1.0
    assert silence_limit(1.0, 3, 1e9) == 1
    assert silence_limit(1e-9, 1, 10.0) == 1  # rarer than its false alarms: nothing to wait for


def test_false_proofs_come_as_often_as_stated() -> None:
    rate, channels, arl = 0.01, 4, 20_000.0
    rng = np.random.default_rng(1)
    watch = DeadChannelTest(np.full(channels, 2 * rate), arl, 1e12)  # half of it is what a living channel must do
    n, found = 1_000_000, 0
    for _ in range(0, n, 50_000):
        words = np.packbits(rng.random((50_000, channels)) < rate, axis=1, bitorder="little")
        for row in range(0, 50_000, 10):  # blocks of 10: a silence is counted a little too short
            watch.take_exposures(words[row : row + 10])
            watch.returned()
            found += len(watch.look())
    assert 0.6 * n / arl <= found <= 1.15 * n / arl


def test_false_inferences_are_no_more_than_stated() -> None:
    n, arl = 60_000, 1_000.0
    _, found = watched(objects(2, n), arl)
    assert 0 < len(found) <= 1.2 * n / arl


def test_silences_against_plain_loops() -> None:
    rng = np.random.default_rng(3)
    watch = DeadChannelTest(np.full(11, 0.1), 1e6, 1e6)
    silent, clicking = [0] * 11, [0] * 11
    for _ in range(200):
        bits = rng.random((int(rng.integers(1, 6)), 11)) < 0.03
        watch.take_exposures(np.packbits(bits, axis=1, bitorder="little"))
        for channel in range(11):
            clicked = any(row[channel] for row in bits)
            silent[channel] = 0 if clicked else silent[channel] + len(bits)
            clicking[channel] += clicked
        assert (watch.silent.tolist(), watch.clicking.tolist()) == (silent, clicking)


@pytest.mark.parametrize("channel", range(N))
def test_a_dead_channel_is_found_soon(channel: int) -> None:
    rows = objects(10 + channel, 3000)
    rows[2000:, channel] = 0
    _, found = watched(rows)
    assert [one for _, one in found] == [channel]
    share = float(SHARES.mean(axis=0)[channel])
    assert found[0][0] - 2000 < 1.3 * silence_limit(share, N, 1e6) + 10


def test_a_scene_without_light_on_one_pattern_is_not_a_dead_channel() -> None:
    """The second half shows one kind of object only, or one object again and again: silent channels, but others change too."""
    lopsided = SHARES.copy()
    lopsided[1, 0] = lopsided[1, 3] = 0.0
    for seed, then in ((20, lopsided[1:]), (21, (lopsided[1:] > 0.25).astype(np.float64))):
        rows = np.concatenate([objects(seed, 3000, lopsided), objects(seed + 5, 3000, then)])
        _, found = watched(rows)
        assert found == []


def test_the_dark_counts_prove_it_whatever_the_scene() -> None:
    """Objects that leave channel 0 without light: it lives as long as it has dark counts, and is dead without."""
    rng = np.random.default_rng(22)
    for alive in (True, False):
        watch = DeadChannelTest(np.full(2, 1e-3), 1e8, 1e8)
        found = []
        for first in range(0, 100_000, 100):
            bits = rng.random((100, 2)) < (1e-3 if alive or first < 20_000 else 0.0, 0.4)
            watch.take_exposures(np.packbits(bits, axis=1, bitorder="little"))
            found += [(first, one) for one in watch.look()]
        assert [one.channel for _, one in found] == ([] if alive else [0])
        if not alive:
            assert found[0][1].proved
            assert found[0][0] < 20_000 + 1.05 * silence_limit(5e-4, 2, 1e8)


def test_windows_of_one_object_are_one_object() -> None:
    watch = DeadChannelTest(np.full(1, 1e-9), 1e12, 1e6)
    for number in range(100):
        for shot in range(5):
            watch.take_objects(np.array([[shot == 3 and number % 2 == 1]]), np.array([number]))
    watch.end_object()
    assert watch.objects == 100
    assert watch.clicked.tolist() == [50]


def test_many_windows_at_once_are_found_dead_as_one_by_one() -> None:
    """With objects of several windows, of which some are nobody's, and a channel that dies: the same findings, at the same window."""
    rng, findings = np.random.default_rng(7), []
    rows = objects(31, 3000) > 0
    rows[1200:, 1] = False
    numbers = np.where(rng.random(3000) < 0.1, NO_OBJECT, np.arange(3000) // 3)
    for at_once in (1, 7, 640, 3000):
        guard = DarkGuard(
            parallel(N, 1), ChannelWatch(N, np.full(N, 1e-4)), lit=DeadChannelTest(np.full(N, 1e-4), 1e9, 1e4)
        )
        for first in range(0, 3000, at_once):
            guard.take_objects(rows[first : first + at_once], numbers[first : first + at_once])
        lit = guard.lit
        state = (lit.objects, lit.clicked.tolist(), lit._quiet.tolist(), lit._due.tolist(), lit._then.tolist())
        findings.append(([(one.channels, one.words) for one in guard.news()], state))
    assert findings[0][0][0][0] == (1,)
    assert all(one == findings[0] for one in findings)


def test_a_channel_that_clicks_again_is_judged_as_soon_as_before() -> None:
    """A silence that a change of scene explains is looked at later and later; the next one, of a channel that has clicked, is not."""
    rows = objects(32, 4000)
    rows[2000:2400] = objects(33, 400, SHARES[1:])
    rows[2000:2400, 1] = 0
    rows[3000:, 1] = 0
    _, found = watched(rows)
    assert [one for _, one in found] == [1]
    assert 3000 < found[0][0] < 3100


def test_a_channel_that_returns_is_alive() -> None:
    rows = objects(30, 4000)
    rows[2000:2500, 1] = 0
    watch, found = watched(rows)
    assert [one for _, one in found] == [1]
    assert watch.returned() == []


def test_the_guard_names_it_and_says_when_it_is_over() -> None:
    plan = parallel(N, 3)  # a dark frame, then three shots
    lit = DeadChannelTest(np.full(N, 1e-4), 1e9, 1e6)
    guard = DarkGuard(plan, ChannelWatch(N, np.full(N, 1e-4)), lit=lit)
    rng = np.random.default_rng(40)
    events = []
    for number in range(2500):
        bits = rng.random((4, N)) < SHARES[rng.integers(2)]
        bits[0] = False
        if 1500 <= number < 2000:
            bits[:, 4] = False
        words = np.packbits(bits, axis=1, bitorder="little")
        found = guard.take(FrameBlock(0, 0, number, 4 * number, 100, 0, words))
        events += [finding.event() for finding in found]
        guard.take_object(bits.sum(axis=0).astype(np.int64), number)
    assert [(event["state"], event["channels"]) for event in events] == [("dead", [4]), ("over", [4])]
    assert "the other channels click as before" in events[0]["words"]
    assert events[0]["level"] == "warning"
    assert guard.health.present == []


def test_one_detector_is_dead_when_nothing_clicks() -> None:
    plan = shot_major(3, 1)
    guard = DarkGuard(plan, ChannelWatch(1, np.array([1e-4])), lit=DeadChannelTest(np.array([1e-4]), 1e9, 1e6))
    rng = np.random.default_rng(41)
    events = []
    for number in range(3000):
        bits = (rng.random(4) < (1e-4, 0.3, 0.0, 0.5)).astype(np.uint8)  # one pattern has no light: not dead
        if number >= 2000:
            bits[:] = 0
        shown = np.array([DARK_PATTERN, 0, 1, 2], np.uint16)
        found = guard.take(ClickBlock(0, 0, number, 4 * number, 100, 0, shown, bits))
        events += [finding.event() for finding in found]
        guard.take_object(bits[1:].astype(np.int64), NO_OBJECT)
    assert [(event["state"], event["level"]) for event in events] == [("dead", "alarm")]
    assert "no light at all" in events[0]["words"]


def test_a_run_finds_a_dead_channel_and_a_replay_agrees(tmp_path: Path, pans: Pans) -> None:
    bundle = ROOT / "runtime/pans/shipped" / "fashion10.pans"
    device = "sim:oled-qcmos?scene=fashion200&pace=fast&seed=3&changes=dead:at_s=10:channel=0"
    words = ["run", str(bundle), "--device", device, "--decisions", "400", "--on-dark", "mask", "--out", str(tmp_path)]
    summary = pans(*words, code=1)
    assert {one["state"] for one in summary["dark"]["findings"]} == {"dead"}
    assert any("clicked with" in fault for fault in summary["faults"])
    assert summary["abstained"] > 100
    assert pans("replay", tmp_path / "run.pansrec")["identical"]
