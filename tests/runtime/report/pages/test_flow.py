"""Report pages and replays of runs in which objects passed by: whole, cut, and in parts."""

from pathlib import Path

import numpy as np
import pytest
from commands import Pans, page_of, words_of

from pans.app.main import main
from pans.record.reading import read_recording
from pans.report.pages.rates import BINS
from pans.report.pages.run import Decisions, Events


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
    gates = "asked {asked}, done {done}, refused {refused}, expired {expired}".format_map(summary["gates"])
    sections = ("Objects that passed by", "Decisions by what became of them", "true class in rows")
    for text in (*sections, *shares, gates):
        assert text in words
    assert "spread over trials" not in words
    assert "Late and missing work" not in words


def test_pulses_and_late_decisions_are_counted_by_their_events(run: Path) -> None:
    recording = read_recording(run)
    rows = recording.decisions()
    asked = rows["index"][rows["label"] == 0].astype(int)
    first = int(rows["index"][100])  # of a later part of a run, whose numbers go on
    for start in (0, 100):
        part = rows[start:]
        n, mine = len(part), asked[asked >= int(part["index"][0])]
        decisions = Decisions(recording.header["config"], n, recording.bundle().classes, int(part["index"][0]))
        events = Events(decisions)
        for block in (part[:50], part[50:]):
            decisions.take(block)
        late = {"kind": "blame", "what": "late"}
        events.take(
            [
                {"kind": "gate_refused", "decision": int(mine[0]), "text": "late"},
                {"kind": "gate_refused", "command_id": 3},  # of no decision
                {"kind": "gate_expired", "decision": int(mine[2])},
                late | {"cause": "link", "decisions": 2, "first_decision": first, "why": "w"},
                late | {"cause": "host", "decisions": 3, "first_decision": first + 9, "sure": False, "why": "v"},
                {"kind": "blame", "what": "missing", "cause": "link", "exposures": 7},
                {"kind": "gate_expired", "decision": 1 << 62},  # that there is not
            ]
        )
        assert decisions.pulses() == {"asked": len(mine), "done": len(mine) - 2, "refused": 1, "expired": 1}
        link, host = events.causes()
        assert (link[:3], host[:3]) == (("link", 2, 7), ("host", 3, 0))
        assert f"Late from decision {first} on (2 decisions): the cause is link: w" in link[3]
        assert f"Late from decision {first + 9} on (3 decisions): the cause is host, not certain: v" in host[3]
        over, place = decisions.over, first - int(part["index"][0])
        assert over.sums["late link"].tolist() == np.bincount([place // over.width], [2], BINS).tolist()
        assert over.sums["late host"].tolist() == np.bincount([(place + 9) // over.width], [3], BINS).tolist()
        outcomes = [sums.sum() for name, sums in over.sums.items() if name.startswith("outcome ")]
        assert sum(outcomes) == over.sums["decisions"].sum() == n


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
