"""The page and the exports of a run with an automaton: its walks and states are those of the recorded messages."""

import csv
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from automata import automaton_bundle, random_automaton
from commands import Pans

from pans.bundle.sensor.bundle import write_bundle
from pans.decide.decision import DECISION_DTYPE, DecisionFlag
from pans.protocol.wire import DARK_PATTERN, MessageType, unpack_body
from pans.protocol.wire.messages import decode_clicks
from pans.record.reading import Recording, read_recording
from pans.record.reading.exposures import iter_exposures
from pans.record.reading.sent_plan import recorded_plan
from pans.report.pages import rates as rates_module
from pans.report.pages.bundle import first_states
from pans.report.pages.rates import Rates
from pans.report.pages.run import Decisions, Walks, light_changes


@pytest.fixture
def recording(tmp_path: Path, pans: Pans) -> Recording:
    write_bundle(
        automaton_bundle(random_automaton(4, slots=6, width=5), levels=2, photons_per_level=0.7), tmp_path / "walk.pans"
    )
    images = np.random.default_rng(2).integers(0, 256, (30, 2, 2)).astype(np.uint8)
    labels = np.arange(30, dtype=np.int16) % 3
    np.savez(tmp_path / "tiny.npz", images=images, labels=labels, classes=np.array(["c0", "c1", "c2"]))
    device = f"sim:dmd-spad?scene={tmp_path / 'tiny.npz'}&seed=5&pace=fast"
    words = ("--device", device, "--decisions", 60, "--trials", 2, "--out", tmp_path / "run")
    pans("run", tmp_path / "walk.pans", *words, code=None)
    return read_recording(tmp_path / "run" / "run.pansrec")


def shown_states(recording: Recording) -> list[tuple[int, int]]:
    """Every lit exposure's stamp and click, message by message."""
    found = []
    for _, body in recording.messages():
        frame = unpack_body(body)
        if frame.type == MessageType.CLICKS:
            block = decode_clicks(frame.payload)
            found += list(zip(block.patterns.tolist(), block.bits.tolist()))
    return [(stamp, bit) for stamp, bit in found if stamp != DARK_PATTERN]


def test_the_first_states_tell_what_was_shown_and_what_clicked(recording: Recording) -> None:
    plan, bundle = recorded_plan(recording), recording.bundle()
    states = shown_states(recording)
    times, clicks = Counter(state for state, _ in states), Counter(state for state, bit in states if bit)
    guard, watched = recording.header["config"]["dark"]["guard"], recording.summary["dark"]["channels"][0]["exposures"]
    assert guard["afterpulses"] == 1  # an exposure behind a click is left out
    rates = Rates(plan, wanted=(watched - 1, watched), left_out=guard["afterpulses"])
    for item in iter_exposures(recording, plan):
        rates.take(item)
    assert [*rates.dark_ticks] == [watched - 1] != [recording.summary["dark"]["exposures"] - 1]
    pictures = first_states(bundle, plan.automaton, rates)
    assert len(pictures) == min(24, plan.automaton.n_states)
    for state, (name, _, lines) in enumerate(pictures):
        assert name.startswith(f"state {state}, ")
        seen = f"{100 * times[state] / times[0]:.0f} % of the walks, clicked in {100 * clicks[state] / max(times[state], 1):.0f} %"
        assert lines[0] == (seen if times[state] else "never shown")
        for line, successor in zip(lines[1:], plan.automaton.successors[state][::-1].tolist(), strict=True):
            best = bundle.classes[int(plan.automaton.posteriors[successor].argmax())]
            where = f"state {successor}" if successor < plan.automaton.n_states else "the end"
            assert re.fullmatch(rf"(no )?click: {where}, {best} \d+ %", line)


def test_light_over_time_is_that_of_the_messages(recording: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rates_module, "WALKS_PER_BIN", 10)
    plan, bundle = recorded_plan(recording), recording.bundle()
    rates = Rates(plan, state_light=bundle.state_light())
    for item in iter_exposures(recording, plan):
        rates.take(item)
    over, first = rates.walks_over(), [bit for state, bit in shown_states(recording) if state == 0]
    assert over is not None
    assert 2 <= len(over["rate"]) <= 6
    assert over["mean"] == np.mean(first)
    size = round(len(first) / over["end_s"] * (over["seconds"][1] - over["seconds"][0]))
    parts = [first[at : at + size] for at in range(0, len(first), size)]
    assert over["rate"].tolist() == pytest.approx([np.mean(part) for part in parts])
    assert (over["low"] <= over["rate"]).all()
    assert (over["rate"] <= over["high"]).all()
    sizes = [len(part) for part in parts]
    assert np.average(over["light"], weights=sizes) == pytest.approx(recording.summary["illumination_mean"])


def test_clicks_over_time_and_where_they_changed() -> None:
    rows = np.zeros(400, DECISION_DTYPE)
    rows["index"], rows["tick"] = np.arange(400), 1_000_000 * np.arange(400)
    rows["clicks"] = np.where(rows["index"] < 200, 6, 3) + rows["index"] % 2
    rows["flags"][7], rows["clicks"][7] = int(DecisionFlag.GAP), 99
    decisions = Decisions({"tick_hz": 1e6}, len(rows))
    decisions.take(rows)
    over = decisions.clicks()
    assert over is not None
    early, late = over["mean"][over["seconds"] < 190], over["mean"][over["seconds"] > 210]
    assert early == pytest.approx([6.5] * len(early), abs=0.02)
    assert late == pytest.approx([3.5] * len(late), abs=0.02)
    assert (over["high"] - over["low"])[-2] == pytest.approx(2 * 1.96 * 0.5 / np.sqrt(60), rel=0.01)
    found = {"kind": "light_changed", "since": 200, "decision": 251}
    ((since, at),) = light_changes([found, {"kind": "gap"}, found | {"decision": 900}], decisions)
    assert (since, at) == pytest.approx((200, 250), abs=1)


def test_reliability_is_that_of_the_decisions() -> None:
    rows = np.zeros(8, DECISION_DTYPE)
    rows["probability"] = [0.05, 0.32, 0.38, 0.38, 1.0, 0.5, 0.5, 0.5]
    rows["label"][:5] = [1, 2, 1, 2, 2]
    rows["truth"] = 2
    rows["truth"][5] = -1
    rows["flags"][6:] = int(DecisionFlag.ABSTAINED), int(DecisionFlag.ABSTAINED | DecisionFlag.GAP)
    rows["exposures"], rows["clicks"] = [3, 4, 4, 4, 4, 4, 4, 2], [0, 1, 2, 3, 9, 1, 1, 0]
    walks = Walks(random_automaton(4, slots=6, width=5))
    for part in (rows[:2], rows[2:]):
        walks.take(part)
    assert walks.exposures == {3: 1, 4: 6}  # the last one came to no leaf
    assert walks.clicks == {0: 1, 1: 3, 2: 1, 3: 1, 9: 1}
    bins = walks.reliability()
    assert [round(share, 3) for _, _, share in bins] == [0.2, 0.6, 0.2]
    assert [accuracy for _, accuracy, _ in bins] == pytest.approx([0, 2 / 3, 1])
    assert bins[1][0] == pytest.approx(0.36)


def test_exports_have_states_and_exposures(recording: Recording, tmp_path: Path, pans: Pans) -> None:
    pans("export", recording.path, "--format", "csv", "-o", tmp_path / "csv")
    plan = recorded_plan(recording)
    with (tmp_path / "csv" / "clicks.csv").open(newline="") as file:
        clicks = [row for row in csv.DictReader(file) if row["dark_slot"] == "0"]
    assert [int(row["state"]) for row in clicks] == [state for state, bit in shown_states(recording) if bit]
    assert [int(row["pattern"]) for row in clicks] == plan.automaton.pattern[[int(r["state"]) for r in clicks]].tolist()
    with (tmp_path / "csv" / "decisions.csv").open(newline="") as file:
        assert [int(row["exposures"]) for row in csv.DictReader(file)] == recording.decisions()["exposures"].tolist()
