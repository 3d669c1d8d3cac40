"""Detector states told apart, tables for a changed detector against exact Bayes, and the policies in live runs and replays."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import Pans
from numpy.typing import NDArray
from plans import parallel, shot_major

from pans.app.main import main
from pans.base import SHIPPED
from pans.base.errors import UsageError
from pans.bundle.backends import n_features_of
from pans.bundle.backends.table import TableDecider
from pans.bundle.sensor.bundle import load_bundle
from pans.decide.dark.cusum import ChannelWatch, WatchSettings
from pans.decide.dark.guard import (
    MAX_MIXED,
    DarkGuard,
    HeadAdapter,
    TableAdapter,
    adapted_scores,
    dark_clicks,
    extra_probability,
    make_adapter,
    meant,
    word_prior,
)
from pans.decide.dark.health import ChannelHealth, Finding, dark_report
from pans.instrument.detector import Afterpulses
from pans.protocol.wire.messages import ClickBlock

N = 8


def found_states(bits: NDArray[np.bool_], rate: float = 0.01, block: int = 500) -> tuple[ChannelHealth, list[Finding]]:
    watch = ChannelWatch(bits.shape[1], np.full(bits.shape[1], rate), WatchSettings(arl_exposures=1e7))
    health, found = ChannelHealth(watch), []
    words = np.packbits(bits, axis=1, bitorder="little")
    for first in range(0, len(words), block):
        found += health.take(watch.update_words(words[first : first + block]))
    return health, found


def dark(seed: int, n: int, rates: float | NDArray[np.float64], channels: int = N) -> NDArray[np.bool_]:
    return np.random.default_rng(seed).random((n, channels)) < rates


def test_dark_clicks_beyond_those_known_have_a_probability_and_fewer_have_none() -> None:
    found = extra_probability(np.array([0.02, 0.01, 0.005, 1.0]), np.array([0.01, 0.01, 0.01, 0.5]))
    assert found.tolist() == pytest.approx([0.01 / 0.99, 0.0, 0.0, 1.0])


def test_nothing_wrong() -> None:
    health, found = found_states(dark(1, 200_000, 0.01))
    assert (found, health.present, health.rates().tolist()) == ([], [], [0.01] * N)


@pytest.mark.parametrize(
    ("channel", "factor", "kind", "level"),
    [(5, 3.0, "hot", "warning"), (5, 20.0, "hot", "alarm"), (2, 0.0, "quiet", "notice")],
)
def test_one_channel_that_changes(channel: int, factor: float, kind: str, level: str) -> None:
    rates = np.where(np.arange(N) == channel, 0.01 * factor, 0.01)
    health, (found,) = found_states(np.concatenate([dark(2, 20_000, 0.01), dark(3, 20_000, rates)]))
    assert (found.kind, found.channels, found.level) == (kind, (channel,), level)
    assert health.rates()[channel] == pytest.approx(0.01 * factor, rel=0.1, abs=0.003)
    assert health.rates()[channel - 1] == 0.01
    assert factor < 1 or abs(found.since - 20_000) < 300
    assert f"channel {channel}" in found.words


def test_a_burst_ends() -> None:
    health, found = found_states(np.concatenate([dark(4, 20_000, 0.01), dark(5, 2_000, 0.2), dark(6, 60_000, 0.01)]))
    assert [one.kind for one in found] == ["burst", "over"]
    assert (found[0].level, len(found[0].channels), health.present) == ("alarm", N, [])
    assert "all channels" in found[0].words


def test_a_drift() -> None:
    slow = 0.01 * np.linspace(1.0, 2.5, 40_000)[:, None]
    _, found = found_states(np.concatenate([dark(7, 10_000, 0.01), dark(8, 40_000, slow)]))
    assert {one.kind for one in found} == {"drift"}
    assert len(found[0].channels) == N


def test_a_burst_found_in_few_exposures_is_not_over_at_the_first_silence() -> None:
    """An alarm after two clicks in two exposures is no proof of a rate of 1."""
    for seed in range(20):
        bits = np.concatenate([dark(60 + seed, 3_000, 1e-4, 1), dark(90 + seed, 300, 0.6, 1)])
        _, found = found_states(bits, 1e-4, block=1)
        assert [one.kind for one in found] == ["burst"]


def test_one_detector() -> None:
    _, found = found_states(np.concatenate([dark(11, 20_000, 0.01, 1), dark(12, 3_000, 0.3, 1)]))
    assert [one.kind for one in found] == ["burst"]
    assert "the detector clicks" in found[0].words


def bayes(
    light: NDArray[np.float64], dark_rates: NDArray[np.float64], shots: int = 1
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """P(c | object) of all vectors of counts, channel 0 the lowest digit, and the log posterior of the classes (two objects each)."""
    base, d = shots + 1, light.shape[1]
    p = 1 - np.exp(-light) * (1 - dark_rates)
    each = np.stack([math.comb(shots, c) * p**c * (1 - p) ** (shots - c) for c in range(base)], axis=2)
    digits = np.arange(base**d)[:, None] // base ** np.arange(d) % base
    like = np.prod([each[:, channel, digits[:, channel]] for channel in range(d)], axis=0)
    return like, np.log(like.reshape(-1, 2, base**d).sum(axis=1).T + 1e-300)


def accuracy(labels: NDArray[np.int64], like: NDArray[np.float64]) -> float:
    truth = np.arange(len(like)) // 2
    return float(np.mean([(like[row] * (labels == truth[row])).sum() for row in range(len(like))]))


def test_tables_for_more_dark_counts_are_nearly_those_of_exact_bayes() -> None:
    rng = np.random.default_rng(3)
    lost, kept = [], []
    for _ in range(8):
        light = rng.exponential(0.8, (8, 8)) * (rng.random((8, 8)) < 0.5)
        before, after = np.zeros(8), np.full(8, 0.15)
        after[rng.integers(8)] = 0.6
        like, scores = bayes(light, before)
        like_now, scores_now = bayes(light, after)
        seen = rng.multinomial(20_000, like.mean(axis=0))
        made = adapted_scores(
            scores.astype(np.float32), word_prior(seen), extra_probability(after, before), np.zeros(8, np.bool_)
        )
        best = accuracy(scores_now.argmax(axis=1), like_now)
        lost.append(best - accuracy(scores.argmax(axis=1), like_now))
        kept.append(best - accuracy(made.argmax(axis=1), like_now))
    assert np.mean(lost) > 0.05  # the old tables suffer
    assert np.mean(kept) < 0.01  # and the new ones hardly
    assert max(kept) < 0.03


def test_unchanged_detector_leaves_the_table_as_it_is_and_a_masked_channel_says_nothing() -> None:
    rng = np.random.default_rng(5)
    scores = rng.normal(size=(64, 3)).astype(np.float32)
    made = adapted_scores(scores, word_prior(np.ones(64, np.int64)), np.zeros(6), np.zeros(6, np.bool_))
    assert (made.argmax(axis=1) == scores.argmax(axis=1)).all()
    table = TableDecider(made, 1)
    assert table.decide(np.array([1, 0, 1, 0, 0, 1]), 1).label == int(scores[0b100101].argmax())
    alone = TableAdapter(scores, 2).made(table, np.zeros(6), np.arange(6) == 2)  # which decides without channel 2
    assert alone.decide(np.array([1, 0, 1, 0, 0, 1]), 1) == alone.decide(np.array([1, 0, 0, 0, 0, 1]), 1)


@pytest.mark.parametrize("shots", [1, 2, 3])
def test_tables_of_counts_are_exact_when_the_prior_is(shots: int) -> None:
    """With the true P(c), new scores are the exact joint probability of the changed detector: loops over everything."""
    rng = np.random.default_rng(50)
    light, d, base = rng.exponential(0.8, (6, 4)), 4, shots + 1
    extra, masked = np.array([0.1, 0.0, 0.3, 0.0]), np.array([False, True, False, False])
    like, scores = bayes(light, np.zeros(d), shots)
    made = adapted_scores(scores.astype(np.float32), like.mean(axis=0), extra, masked, base)
    now, _ = bayes(light[:, ~masked], extra[~masked], shots)
    digits = np.arange(base**d)[:, None] // base ** np.arange(d) % base
    key = digits[:, ~masked] @ base ** np.arange(3)
    wanted = now.reshape(-1, 2, base**3).sum(axis=1).T / len(light)
    assert np.exp(made.astype(np.float64)) == pytest.approx(wanted[key], rel=2e-5)


def test_moves_of_dark_clicks_are_binomial() -> None:
    moves = dark_clicks(3, 0.2)
    assert moves.sum(axis=1) == pytest.approx(np.ones(4))
    assert moves[1] == pytest.approx([0, 0.64, 0.32, 0.04])
    assert dark_clicks(2, 0.0).tolist() == np.eye(3).tolist()


@pytest.mark.parametrize(("rows", "base"), [(32, 2), (27, 3)])
def test_the_prior_is_a_distribution_also_without_words(rows: int, base: int) -> None:
    assert word_prior(np.zeros(rows, np.int64), base) == pytest.approx(np.full(rows, 1 / rows))
    seen = np.zeros(rows, np.int64)
    seen[5] = 10**6
    assert word_prior(seen, base).sum() == pytest.approx(1.0)
    assert word_prior(seen, base)[5] > 0.999
    assert base ** n_features_of(rows, base) == rows


def test_what_a_channel_meant_is_bayes() -> None:
    rng = np.random.default_rng(51)
    seen = rng.integers(1, 1000, 3)
    own = (seen + 0.5) / (seen.sum() + 1.5)
    weights = meant(seen, 0.25, masked=False)
    for found in range(3):
        joint = np.array([own[c] * dark_clicks(2, 0.25)[c, found] for c in range(3)])
        assert weights[found] == pytest.approx(joint / joint.sum())
    assert meant(seen, 0.0, masked=True) == pytest.approx(np.tile(own, (3, 1)))


def test_a_mixed_head_keeps_most_of_what_is_lost_without() -> None:
    """One dead and one hot channel: the head as it is, mixed over both, and exact for the changed detector."""
    rng = np.random.default_rng(52)
    shots, d, lost, kept = 2, 5, [], []
    base = shots + 1
    digits = np.arange(base**d)[:, None] // base ** np.arange(d) % base
    for _ in range(6):
        light = rng.exponential(0.8, (8, d)) * (rng.random((8, d)) < 0.6)
        like, scores = bayes(light, np.zeros(d), shots)
        after = light.copy()
        after[:, 1] = 0.0
        extra, masked = np.array([0, 0, 0, 0.5, 0]), np.array([False, True, False, False, False])
        like_now, best = bayes(after, extra, shots)
        adapter, head = HeadAdapter(d, shots), TableDecider(scores.astype(np.float32), shots, shots)
        for word in rng.choice(base**d, 3000, p=like.mean(axis=0) / like.mean(axis=0).sum()):
            adapter.count(digits[word])
        mixed = adapter.made(head, extra, masked)
        optimum = accuracy(best.argmax(axis=1), like_now)
        lost.append(optimum - accuracy(scores.argmax(axis=1), like_now))
        kept.append(optimum - accuracy(mixed.decide_batch(digits, shots), like_now))
        verdict = mixed.decide(digits[77], shots)
        assert verdict.label == mixed.decide_batch(digits[77:78], shots)[0]
        assert 0 < verdict.probability <= 1
    assert np.mean(lost) > 0.05
    assert np.mean(kept) < 0.5 * np.mean(lost)


def test_what_is_too_much_to_mix_is_not_decided() -> None:
    adapter = HeadAdapter(20, 3)
    concerned = np.zeros(20, np.bool_)
    concerned[:4] = True
    assert adapter.can_do(concerned)
    assert MAX_MIXED == 4**4
    concerned[4] = True
    assert not adapter.can_do(concerned)


def test_the_adapter_fits_the_bundle() -> None:
    bundle = load_bundle(SHIPPED / "fashion10.pans")[0]
    assert isinstance(make_adapter(bundle, 1), TableAdapter)
    assert isinstance(make_adapter(bundle, 2), TableAdapter)  # 3^10 rows
    assert isinstance(make_adapter(bundle, 3), HeadAdapter)  # 4^10 are too many
    with pytest.raises(UsageError, match="only a table of single clicks"):
        make_adapter(replace(bundle, head_onnx=None), 2)


def test_an_afterpulse_is_no_dark_count() -> None:
    plan = shot_major(3, 1)  # a dark slot before three patterns: right behind the last of them
    rng = np.random.default_rng(6)
    bits = np.zeros(4 * 20_000, np.uint8)
    for slot in range(len(bits)):
        p = 0.01 if slot % 4 == 0 else 0.5
        bits[slot] = rng.random() < 1 - (1 - p) * (1 - 0.02 * bits[slot - 1])
    found = {}
    for afterpulses in (True, False):
        watch = ChannelWatch(1, np.array([0.01]), WatchSettings(arl_exposures=1e7))
        guard = DarkGuard(plan, watch, afterpulses=afterpulses)
        events = []
        for first in range(0, len(bits), 40):
            if first == 4000:
                continue  # a gap: what was before the next block is not known
            shown = np.resize(plan.slot_pattern, 40)
            events += guard.take(ClickBlock(0, 0, 0, first, 100, 0, shown, bits[first : first + 40]))
        found[afterpulses] = [finding.kind for finding in events]
        report = guard.report(dark_report(0.01, 20_000, int(bits[::4].sum())))
        assert bool(report.alarm) != afterpulses
        behind_silence = bits[4::4][bits[3:-1:4] == 0]
        if afterpulses:
            assert watch.exposures == pytest.approx(len(behind_silence), abs=12)
    assert found[True] == []
    assert found[False]


@pytest.mark.parametrize(("chance", "found"), [(0.02, False), (1.0, True)])
def test_dark_exposures_after_clicks_are_held_against_the_highest_chance_of_an_afterpulse(
    chance: float, found: bool
) -> None:
    plan, expected = shot_major(3, 1), np.array([0.01])
    watch = ChannelWatch(1, expected, WatchSettings(arl_exposures=1e7))
    most = np.array([Afterpulses(0.02).chance_after_clicks(0.01, 5.0)])
    assert most[0] == pytest.approx(1 - 0.99 * 0.98)
    behind = ChannelWatch(1, most, WatchSettings(arl_exposures=1e7), np.array([1e-9]))
    guard = DarkGuard(plan, watch, "warn", afterpulses=1, behind=behind)
    bits = np.ones(4 * 1500, np.uint8)
    bits[::4] = np.random.default_rng(3).random(1500) < chance
    findings = []
    for first in range(0, len(bits), 40):
        shown = np.resize(plan.slot_pattern, 40)
        findings += guard.take(ClickBlock(0, 0, 0, first, 100, 0, shown, bits[first : first + 40]))
    report = guard.report(dark_report(0.01, 1500, int(bits[::4].sum())))
    assert (watch.exposures, behind.exposures) == (0, 1500)
    assert [(one.kind, one.level) for one in findings] == [("burst", "alarm")] * found
    assert all("right after clicks" in one.words and one.event()["after_clicks"] for one in findings)
    assert [one.words for one in guard.present] == [one.words for one in findings]
    assert ("right after clicks" in report.alarm) == found


def test_dark_exposures_of_which_none_can_be_watched_are_an_alarm() -> None:
    plan = shot_major(3, 1)
    guard = DarkGuard(plan, ChannelWatch(1, np.array([0.01])), "warn", afterpulses=2)
    assert "none of 100 dark exposures" in guard.report(dark_report(0.01, 100, 1)).alarm
    assert guard.report(dark_report(0.01, 5, 0)).alarm == ""


@pytest.mark.parametrize("tau", [0.0, 0.5, 3.0])
def test_no_history_leads_to_a_higher_chance_than_the_highest(tau: float) -> None:
    law, rng = Afterpulses(0.1, tau, 0.1), np.random.default_rng(1)
    most, memory = law.chance_after_clicks(0.01, 4.0), np.zeros(2)
    for _ in range(300):
        light = float(rng.choice([0.0, 1.0, 4.0]))
        memory = law.after(light + 0.01, memory, int(rng.random() < 0.8))
        assert law.chance(0.01, memory) <= most * (1 + 1e-3)


def test_a_detector_that_always_clicks_fails(tmp_path: Path, pans: Pans) -> None:
    device = "sim:dmd-spad?scene=fashion200&seed=1&pace=fast&changes=dark:at_s=0.01:factor=10000"
    words = ["run", "fashion-adaptive", "--device", device, "--decisions", "200", "--no-realtime", "--out", tmp_path]
    summary = pans(*words, code=1)
    assert summary["verdict"] == "FAIL"
    assert any(fault.startswith("right after clicks the detector clicks") for fault in summary["faults"])
    assert main(["replay", str(tmp_path / "run.pansrec")]) == 0


def test_dark_exposures_count_when_it_was_silent_for_long_enough() -> None:
    plan = shot_major(3, 1)
    bits = (np.random.default_rng(2).random(4000) < 0.2).astype(np.uint8)
    for quiet in (1, 3, 7):
        watch = ChannelWatch(1, np.array([0.2]), WatchSettings(arl_exposures=1e7))
        guard = DarkGuard(plan, watch, afterpulses=quiet)
        for first in range(0, len(bits), 8):  # shorter than what must be silent, and longer
            shown = np.resize(plan.slot_pattern, 8)
            guard.take(ClickBlock(0, 0, 0, first, 100, 0, shown, bits[first : first + 8]))
        dark = range(0, len(bits), 4)
        assert watch.exposures == sum(t >= quiet and not bits[t - quiet : t].any() for t in dark)


def test_it_is_silent_for_long_enough_when_afterpulses_hide_behind_dark_counts() -> None:
    law = Afterpulses(0.05, 2.0, 0.1)
    behind = law.exposures_seen(1e-4)
    memory = law.sight(law.after(1e-3, np.zeros(2), 1)) * law.decay ** np.array([behind - 2, behind])
    assert memory[0] > 1e-5 > memory[1]
    assert (Afterpulses(0.0).exposures_seen(1e-4), Afterpulses(0.1).exposures_seen(1e-4)) == (0, 1)


def test_empty_fields_as_counts() -> None:
    watch = ChannelWatch(3, np.full(3, 0.01), WatchSettings(arl_exposures=1e7))
    guard = DarkGuard(parallel(3, 4), watch, "warn")
    events = []
    for _ in range(200):
        events += guard.take_empty(256, np.array([2, 3, 12], np.int64))
    assert [(finding.kind, finding.channels) for finding in events] == [("hot", (2,))]
    assert "channel 2" in guard.health.present[0].words


def test_tables_and_masks_need_a_bundle() -> None:
    watch = ChannelWatch(1, np.array([0.01]))
    with pytest.raises(UsageError, match="needs a bundle"):
        DarkGuard(shot_major(3, 1), watch, "tables")
    with pytest.raises(UsageError, match="allowed: warn"):
        DarkGuard(shot_major(3, 1), watch, "panic")


SCENE = """kind = "still"
images = "fashion200"
[[change]]
at_s = 10.0
kind = "dark"
factor = 20000.0
"""


@pytest.mark.parametrize(
    ("policy", "shots", "abstains"),
    [
        ("warn", 1, False),
        ("tables", 1, False),
        ("mask", 1, True),
        ("abstain", 1, True),
        ("tables", 2, False),
        ("mask", 3, True),
    ],
)
def test_a_run_says_so_and_a_replay_agrees(policy: str, shots: int, abstains: bool, tmp_path: Path, pans: Pans) -> None:
    """A table of counts is made anew; where the one detector of all patterns is masked, nothing is left to decide with."""
    (tmp_path / "hot.toml").write_text(SCENE)
    device = f"sim:oled-qcmos?scene={tmp_path}/hot.toml&pace=fast&seed=2"
    words = ("--decisions", 150, "--shots", shots, "--on-dark", policy, "--out", tmp_path)
    summary = pans("run", SHIPPED / "fashion10.pans", "--device", device, *words, code=1)
    assert {one["state"] for one in summary["dark"]["findings"]} == {"burst"}
    assert summary["dark"]["policy"] == policy
    assert summary["dark"]["channels"][0]["clicks"] == summary["dark"]["clicks"]
    assert any("times as often as expected" in fault for fault in summary["faults"])
    assert (summary["abstained"] > 50) == abstains
    replayed = pans("replay", tmp_path / "run.pansrec")
    assert (replayed["identical"], replayed["decisions"]) == (True, 150)
    assert main(["verify", str(tmp_path / "run.pansrec")]) == 0
