"""The summary at the end of a recording: what every run writes passes, anything that is none is damage where it is read."""

import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import small_files
from changed_files import places_of

from pans.app.main import main
from pans.base.errors import DamagedFileError
from pans.record.reading import read_recording
from pans.record.reading.format import Kind
from pans.record.reading.recorded_facts import checked_summary

STORED = Path(__file__).parents[2] / "report/summary"


@pytest.fixture(params=["still", "walks", "flow"])
def whole(request: pytest.FixtureRequest) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((STORED / f"summary_{request.param}.json").read_text())
    return found


def test_what_runs_write_passes(whole: dict[str, Any]) -> None:
    for facts in (whole, {}, {"part_ended": "full", "next": "run.0002.pansrec"}):
        assert checked_summary(facts, "run") is facts


def test_keys_of_later_versions_may_be_missing(whole: dict[str, Any]) -> None:
    for key in ("judged", "decided", "photons_known", "figures_of", "late_allowed", "busy", "exposure_timing", "light"):
        whole.pop(key, None)
    checked_summary(whole, "run")


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("verdict", "MAYBE", "verdict is 'MAYBE', allowed: PASS or FAIL"),
        ("decisions", -1, "decisions is -1, allowed: a whole number from 0"),
        ("accuracy", 1.5, "accuracy is 1.5, allowed: a number from 0 to 1"),
        ("accuracy", "high", "accuracy is 'high'"),
        ("accuracy_ci", [0.5], "accuracy_ci has 1 items, allowed: 2"),
        ("accuracy_stderr_objects", 5e-324, "accuracy_stderr_objects is 5e-324"),
        ("abstained", 1 << 50, "decisions abstained"),
        ("faults", "none", "faults is 'none', allowed: a list"),
        ("faults", [1], "faults: 0 is 1, allowed: a text"),
        ("warnings", 0.5, "warnings is 0.5, allowed: a list"),
        ("latency_us", {"p50": 1.0}, "latency_us has no p99"),
        ("latency_us", None, "latency_us is None, allowed: an object"),
        ("device", [], "device is [], allowed: an object"),
        ("clock", {}, "clock has no worst_uncertainty_us"),
        ("dark", {"exposures": 3}, "dark has no clicks"),
        ("exposure_timing", {"exposures": 3}, "does not say how far they were off"),
    ],
)
def test_what_is_no_summary_is_damage(whole: dict[str, Any], key: str, value: Any, said: str) -> None:
    with pytest.raises(DamagedFileError) as caught:
        checked_summary(whole | {key: value}, "r.pansrec: block 7: END")
    assert caught.value.message.startswith("r.pansrec: block 7: END: the summary")
    assert said in caught.value.message


@pytest.mark.parametrize("key", ["decisions", "abstained", "objects", "trials", "latency_us", "clock", "device"])
def test_a_verdict_needs_its_figures(whole: dict[str, Any], key: str) -> None:
    del whole[key]
    with pytest.raises(DamagedFileError, match=f"but no {key}"):
        checked_summary(whole, "run")


def altered(summary: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the summary with each of its values in turn removed, a list, or a text."""
    for at in range(len(places_of(summary))):
        for other in (None, [], "x"):
            changed = copy.deepcopy(summary)
            parent, key = places_of(changed)[at]
            if other is None:
                del parent[key]
            else:
                parent[key] = other
            yield changed


def test_a_recording_with_any_summary_is_read_or_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The page of a recording is made, of one with another summary as of one that was cut."""
    path = small_files.record_run(tmp_path)
    blocks = small_files.blocks_of(path.read_bytes())
    end = json.loads(blocks[-1][1])
    refused = 0
    for number, summary in enumerate(altered(end["summary"])):
        blocks[-1] = Kind.END, json.dumps(end | {"summary": summary}).encode()
        path.write_bytes(small_files.sealed(blocks))
        found = read_recording(path, salvage=True)
        assert found.complete == (not found.damage)
        refused += not found.complete
        if number % 25 == 0:
            code = main(["report", str(path), "-o", str(tmp_path / "page.html"), "--force"])
            assert code in (0, 1, 2), capsys.readouterr().err
    assert refused > 100


@pytest.mark.parametrize(
    ("kind", "change", "said"),
    [
        (Kind.HEADER, {"created_utc": {}}, "created_utc is {}, allowed: a text"),
        (Kind.HEADER, {"simulated": "no"}, "simulated is 'no', allowed: true or false"),
        (Kind.HEADER, {"config": {"flow": {"settings": {"gate_classes": 3}}}}, "gate_classes is 3, allowed: a list"),
        (Kind.HEADER, {"config": {"dark": "2.4.6"}}, "dark is '2.4.6', allowed: an object"),
        (Kind.EVENTS, {"kind": "blame", "decisions": "x"}, "decisions is 'x', allowed: a whole number"),
        (Kind.EVENTS, {"kind": "dark_state", "state": "hot", "channels": [0]}, "has no dark_exposure"),
        (
            Kind.EVENTS,
            {"kind": "part", "number": 0, "first_decision": 0},
            "number is 0, allowed: a whole number from 1",
        ),
    ],
)
def test_header_and_events_are_checked_where_they_are_read(
    kind: Kind, change: dict[str, Any], said: str, tmp_path: Path
) -> None:
    path = small_files.record_run(tmp_path)
    blocks = small_files.blocks_of(path.read_bytes())
    header = json.loads(blocks[0][1]) | (change if kind == Kind.HEADER else {})
    blocks[0] = Kind.HEADER, json.dumps(header).encode()
    if kind == Kind.EVENTS:
        blocks.insert(-1, (kind, json.dumps(change).encode() + b"\n"))
    path.write_bytes(small_files.sealed(blocks))
    with pytest.raises(DamagedFileError) as caught:
        list(read_recording(path).events())
    assert said in caught.value.message
