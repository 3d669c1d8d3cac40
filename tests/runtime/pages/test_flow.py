"""Report pages and replays of runs in which objects passed by: whole, cut, and in parts."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from commands import Pans, page_of, words_of

from pans.runtime.cli import main
from pans.runtime.pages import flow
from pans.runtime.pages.flow import BINS, _late_rows, _pulses, _span_of
from pans.runtime.record import read_recording


@pytest.fixture(scope="module")
def run(flow_folder: Path) -> Path:
    device = f"sim:flow-snspd?scene={flow_folder / 'cells.toml'}&seed=4&pace=fast"
    words = ["run", str(flow_folder / "thirds.pans"), "--device", device, "--flow", str(flow_folder / "flow.toml")]
    assert main([*words, "--seconds", "0.2", "--gate-class", "a", "--out", str(flow_folder / "page")]) == 0
    return flow_folder / "page" / "run.pansrec"


def test_the_page_says_what_the_run_said(run: Path, tmp_path: Path) -> None:
    page = page_of(run, tmp_path)
    words, summary = words_of(page), read_recording(run).summary
    shares = [f"{summary[name]:.3%}" for name in ("accuracy", "missed", "yield", "purity")]
    gates = ", ".join(str(n) for n in summary["gates"].values())
    sections = ("Objects that passed by", "Decisions by what became of them", "true class in rows")
    for text in (*sections, *shares, gates):
        assert text in words
    assert "spread over trials" not in words
    assert "Late and missing work" not in words


def test_pulses_and_late_decisions_are_counted_by_their_events(run: Path) -> None:
    recording = read_recording(run)
    bundle = recording.bundle()
    asked = recording.decisions()["index"][recording.decisions()["label"] == 0].astype(int)

    class Told:
        header, path = recording.header, recording.path

        def iter_decisions(self) -> Any:
            return recording.iter_decisions()

        def events(self) -> Any:
            yield {"kind": "gate_refused", "decision": int(asked[0]), "text": "late"}
            yield {"kind": "gate_refused", "command_id": 3}  # of no decision
            yield {"kind": "gate_expired", "decision": int(asked[2])}
            yield from ({"kind": "late", "decision": number, "latency_us": 2e3} for number in (3, 4, 9, 20))
            yield {"kind": "blame", "what": "late", "cause": "link", "first_decision": 3, "last_decision": 4}
            yield {"kind": "blame", "what": "late", "cause": "host", "first_decision": 9, "last_decision": 20}

    told: Any = Told()
    pulses = _pulses(told, bundle)
    assert pulses["asked"].tolist() == asked.tolist()
    assert (pulses["refused"].tolist(), pulses["expired"].tolist()) == ([asked[0]], [asked[2]])
    assert len(pulses["done"]) == len(asked) - 2
    bins = _bins_of(recording.decisions()["tick"])
    assert {cause: counts.tolist() for cause, counts in _late_rows(told, _span_of(told)).items()} == {
        cause: np.bincount(bins[list(numbers)], minlength=BINS).tolist()
        for cause, numbers in (("link", (3, 4)), ("host", (9, 20)))
    }


def _bins_of(tick: np.ndarray) -> np.ndarray:
    return np.minimum((tick - tick.min()).astype(float) * BINS / float(np.ptp(tick)), BINS - 1).astype(int)


def test_every_decision_is_in_the_stretch_of_its_tick(run: Path) -> None:
    decisions = read_recording(run).decisions()
    decisions["tick"][200:] -= decisions["tick"][200] - decisions["tick"][50]  # a clock that began anew
    for first in (0, 100):  # 100: a later part of a run, whose numbers go on
        part = decisions[first:]
        told: Any = SimpleNamespace(iter_decisions=lambda part=part: iter([part[:50], part[50:]]))
        span, numbers = _span_of(told), part["index"].astype(np.int64)
        assert span.bins(numbers).tolist() == _bins_of(part["tick"]).tolist()
        assert span.bins(np.array([first - 1, numbers[-1] + 1])).tolist() == [-1, -1]


def test_late_decisions_are_counted_once_however_many_events_are_held(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = read_recording(run)
    events = [{"kind": "late", "decision": number} for number in range(300)]
    for first in range(0, 300, 3):  # behind the third of its decisions
        blame = {"kind": "blame", "what": "late", "first_decision": first, "last_decision": first + 1}
        events.insert(4 * first // 3 + 3, blame | {"cause": "link" if first % 2 else "host"})
    told: Any = SimpleNamespace(iter_decisions=recording.iter_decisions, events=lambda: iter(events))
    span = _span_of(told)
    whole = {cause: counts.tolist() for cause, counts in _late_rows(told, span).items()}
    assert sum(map(sum, whole.values())) == 200
    for held in (8, 20, 64):
        monkeypatch.setattr(flow, "EVENTS_AT_ONCE", held)
        assert {cause: counts.tolist() for cause, counts in _late_rows(told, span).items()} == whole


def test_parts_of_a_flow_tell_of_their_passages(flow_folder: Path, tmp_path: Path, pans: Pans) -> None:
    device = f"sim:flow-snspd?scene={flow_folder / 'cells.toml'}&seed=4&pace=fast"
    words = ["run", str(flow_folder / "thirds.pans"), "--device", device, "--flow", str(flow_folder / "flow.toml")]
    summary = pans(*words, "--seconds", "1.5", "--rotate-mb", "1", "--out", tmp_path)
    parts = sorted(tmp_path.glob("run-*.pansrec"))
    assert len(parts) >= 2
    rows = pans("replay", tmp_path)["parts"]
    marks = sum(row["passages"]["marks"] for row in rows)
    assert 0.98 * summary["passages"]["marks"] <= marks <= summary["passages"]["marks"]
    for row in rows:
        assert row["identical"]
        assert abs(row["accuracy"] - summary["accuracy"]) < 0.05
        assert row["passages"]["without_mark"] <= 3
        assert row["missed"] < 0.02
    assert main(["replay", str(parts[1])]) == 0
    text = pans.said().out
    assert ("passages" in text, "accuracy" in text) == (True, True)
    assert "This is one part of a run" in words_of(page_of(parts[1], tmp_path))
