"""The summary of a seeded run, compared key by key with a stored one; latencies in words: what the clock cannot resolve is never 0."""

import json
import re
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from commands import fixed_run, json_of
from mutated_sessions import Stage
from small_runs import record_small

from pans.app.main import main
from pans.app.run.one_run import _exit_code
from pans.base.numbers import Part, keys_of
from pans.report.summary.summary import Summary, WalkFigures, late_words, summarise
from pans.report.summary.words import accuracy_interval, closing_words, dark_words, write_markdown

MEASURED = ("armed_after_s", "realtime", "page_faults", "recording", "report")  # of this machine and this run


def of_a_flow(folder: Path) -> tuple[str, ...]:
    bundle, scene, settings = (str(folder / name) for name in ("thirds.pans", "cells.toml", "flow.toml"))
    device = f"sim:flow-snspd?scene={scene}&seed=4&pace=fast"
    return ("run", bundle, "--device", device, "--flow", settings, "--seconds", "0.1", "--gate-class", "b,c")


@pytest.mark.parametrize("kind", ["still", "walks", "flow"])
def test_the_summary_has_the_contracts_keys_order_and_values(
    kind: str, flow_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    walks = ("demo", "--pace", "fast", "--trials", "1")
    words = {"still": fixed_run(200, 2), "walks": walks, "flow": of_a_flow(flow_folder)}[kind]
    found = json_of(capsys, "", *words, "--out", tmp_path)
    wanted: dict[str, Any] = json.loads((Path(__file__).parent / f"summary_{kind}.json").read_text())
    assert list(found) == list(wanted)
    for key in wanted:
        if key == "device":
            assert list(found[key]) == list(wanted[key])
        elif key == "clock":  # sums whose last digits depend on the processor
            assert found[key] == pytest.approx(wanted[key], rel=1e-9)
        elif key not in MEASURED:
            assert found[key] == wanted[key], key
            if isinstance(wanted[key], dict):
                assert list(found[key]) == list(wanted[key]), key


def test_the_table_of_figures_and_the_typed_results_name_the_same() -> None:
    """A figure without an attribute, or an attribute that the table does not explain, is an error."""
    of_decisions, of_run, of_walks = (set(keys_of(part)) for part in (Part.DECISIONS, Part.RUN, Part.WALKS))
    assert {one.name for one in fields(Summary)} == of_decisions | of_run | {"flow", "walks"}
    assert [one.name for one in fields(WalkFigures)] == [*keys_of(Part.WALKS)]
    assert not of_decisions & of_run
    assert not of_walks & (of_decisions | of_run)


def test_late_decisions_are_a_fault_beyond_the_share_that_is_allowed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    device = ("--device", "sim:oled-qcmos?seed=1&pace=fast&faults=late:60ms/300ms", "--decisions", "100")
    found = {}
    for allowed in ("0", "0.19", "0.2"):
        words = ("run", "fashion10", *device, "--late-allowed", allowed, "--out", str(tmp_path / allowed), "--json")
        code = main([*words])
        found[allowed] = code, json.loads(capsys.readouterr().out)
    assert {code: facts["late"] for code, facts in found.values()} == {4: 20, 0: 20}
    code, facts = found["0.19"]
    assert code == 4
    assert facts["faults"][0].startswith("20 of 100 decisions later than 16.667 ms, allowed 19 % (")
    code, facts = found["0.2"]
    assert (code, facts["verdict"], facts["faults"], facts["late_allowed"]) == (0, "PASS", [], 0.2)
    assert "20.000% of the decisions are allowed" in (tmp_path / "0.2" / "summary.md").read_text()


@pytest.fixture(scope="module")
def summary(tmp_path_factory: pytest.TempPathFactory) -> Summary:
    """Of a run in virtual time, as if it had been in real time."""
    made = Stage("sequential").run(tmp_path_factory.mktemp("run"), 1).summary
    assert made is not None
    assert "latency       not measured in virtual time; late 0" in closing_words(made, "r", "s")
    return replace(made, device=made.device | {"virtual_time": False})


def seen(summary: Summary, p50: float, p99: float, uncertainty_us: float) -> Summary:
    row = {"p50": p50, "p99": p99, "p999": 3000.0, "max": 3000.0}
    stages = summary.stage_latency_us | {"link": row, "decode": {**row, "p50": 0.0}}
    return replace(summary, latency_us=row, stage_latency_us=stages, clock={"worst_uncertainty_us": uncertainty_us})


@pytest.mark.parametrize(
    ("causes", "simulated", "waited_ms", "busy"),
    [
        ({"host": 3, "device": 2}, False, 340, True),
        ({"host": 2, "device": 3}, False, 340, False),  # an instrument of its own
        ({"link": 5}, True, 340, True),  # the simulator waits for the same processors
        ({"link": 5}, True, 34, False),
        ({}, True, 340, False),
    ],
)
def test_a_busy_computer_is_named_where_it_made_decisions_late(
    summary: Summary, causes: dict[str, int], simulated: bool, waited_ms: int, busy: bool
) -> None:
    facts: dict[str, Any] = {"late": sum(causes.values()), "late_cause": causes, "simulated": simulated}
    facts |= {"page_faults": {"waited_ms": waited_ms}, "seconds": 6.0}
    said = closing_words(replace(summary, **facts), "r", "s")
    assert ("the loop waited 340 ms of 6.0 s for a processor" in said) == ("accuracy is not affected" in said) == busy
    assert ("late decisions are as accurate" in closing_words(replace(summary, **facts, lost=1), "r", "s")) == busy


@pytest.mark.parametrize(
    ("p50", "p99", "uncertainty_us", "words"),
    [
        (120.0, 900.0, 5000.0, "p50 120 us, p99 900 us, p99.9 3000 us, max 3000 us; late"),
        (0.0, 0.0, 4.2, "p50 0 us, p99 0 us, p99.9 3000 us, max 3000 us; late"),
        (0.0, 0.0, 2345.0, "p99.9 3000 us, max 3000 us, else not resolved (clock uncertainty 2.3 ms); late"),
    ],
)
def test_closing_words(summary: Summary, p50: float, p99: float, uncertainty_us: float, words: str) -> None:
    assert f"latency       {words}" in closing_words(seen(summary, p50, p99, uncertainty_us), "r", "s")


def test_nothing_resolved(summary: Summary) -> None:
    row = dict.fromkeys(("p50", "p99", "p999", "max"), 0.0)
    doubtful = replace(summary, latency_us=row, clock={"worst_uncertainty_us": 1500.0})
    assert "latency       not resolved (clock uncertainty 1.5 ms); late 0" in closing_words(doubtful, "r", "s")


def test_the_page_has_no_zero_that_was_not_measured(summary: Summary, tmp_path: Path) -> None:
    doubtful = seen(summary, 0.0, 0.0, 2345.0)
    write_markdown(tmp_path / "s.md", doubtful, {}, np.zeros((3, 3), np.int64), ("a", "b", "c"))
    rows = [line for line in (tmp_path / "s.md").read_text().splitlines() if line.startswith("| ")]
    assert "| exposure end to decision | not resolved | not resolved | 3000 | 3000 |" in rows
    assert "| link | not resolved | not resolved | 3000 | 3000 |" in rows
    assert "| decode | 0 | 0 | 3000 | 3000 |" in rows  # of the host's own clock


def test_objects_that_come_again_are_no_trials(summary: Summary, tmp_path: Path) -> None:
    fives = replace(summary, objects=200, trials=5, decisions=1000, decided=1000, judged=1000)
    said = closing_words(fives, "r", "s")
    assert "1000 decisions (200 objects × 5 trials)" in said
    again = replace(fives, trials=1, decisions=88_334, decided=88_334, judged=88_334)
    assert "88334 decisions (200 objects, 441.7 decisions on each on average)" in closing_words(again, "r", "s")
    write_markdown(tmp_path / "s.md", again, {}, np.zeros((3, 3), np.int64), ("a", "b", "c"))
    assert "200 objects, 441.7 decisions on each on average |" in (tmp_path / "s.md").read_text()
    unknown = replace(fives, objects=0, trials=0, judged=0)
    assert "1000 decisions (true classes unknown)" in closing_words(unknown, "r", "s")
    partly = replace(fives, trials=1, judged=500)  # the class of the others is not known
    assert "1000 decisions (200 objects, 2.5 decisions on each on average)" in closing_words(partly, "r", "s")


def test_late_decisions_say_how_sure_the_cause_is_and_where_they_began(summary: Summary, tmp_path: Path) -> None:
    def late(cause: str, sure: bool, first: int) -> dict[str, Any]:
        one = {"kind": "blame", "what": "late", "cause": cause, "sure": sure, "why": "it waited"}
        return one | {"first_decision": first, "decisions": 2}

    events = [late("host", False, 7), late("link", True, 40), late("host", False, 90), late("host", False, 900)]
    result: Any = SimpleNamespace(events=events, late_cause={"link": 2, "host": 6})
    assert late_words(result) == "cause: host 6, not certain; link 2; first at decision 7, 40, 90"
    result.events[2]["sure"] = True
    assert "host 6, not always certain; link 2" in late_words(result)
    write_markdown(tmp_path / "s.md", replace(summary, blame=events), {}, np.zeros((3, 3), np.int64), ("a", "b", "c"))
    page = (tmp_path / "s.md").read_text()
    assert "| 2 late from decision 7 on | host | no | it waited |" in page
    assert "The first 4 causes, of 8 of 0 late decisions and 0 of 0 lost exposures;" in page
    whole = replace(summary, blame=events[:1], late=2)
    write_markdown(tmp_path / "t.md", whole, {}, np.zeros((3, 3), np.int64), ("a", "b", "c"))
    assert "The first" not in (tmp_path / "t.md").read_text()


@pytest.mark.parametrize(
    ("clicks", "exposures", "expected", "words"),
    [
        (56, 2000, 0.015, "higher than expected, not yet sure"),
        (0, 1801, 2.75e-5, "too few to judge: only a mean above 77.4 times"),  # Wilson 1927: 3.84 / (1801 + 3.84)
        (30, 2000, 0.015, "as expected, a mean above 1.42 times"),
        (0, 0, 0.015, ""),
        (0, 1801, 0.0, ""),
    ],
)
def test_dark_counts_of_a_run_are_judged_as_in_the_live_view(
    summary: Summary, clicks: int, exposures: int, expected: float, words: str
) -> None:
    dark = {"clicks": clicks, "exposures": exposures, "expected": expected, "alarm": "", "present": ()}
    found = dark_words(dark, calibrated=False)
    assert found.startswith(words)
    more = {"exposures": 2 * exposures, "clicks": 9 * clicks, "channels": [dark]}  # with what is behind a click, too
    assert dark_words(dark | more, calibrated=False) == found
    assert bool(found) == bool(words)
    assert dark_words(dark | {"alarm": "look"}, calibrated=False) == ""
    assert dark_words(dark, calibrated=True) == ("" if words.startswith("higher") else found)
    said = closing_words(replace(summary, dark=replace(summary.dark, **dark)), "r", "s")
    assert (f"dark counts   {words}" in said) == bool(words)


def test_a_line_has_one_denominator_and_names_it(summary: Summary, tmp_path: Path) -> None:
    of = dict.fromkeys(("accuracy", "clicks_mean", "photons_mean", "illumination"), "judged")
    counts = {"decisions": 4686, "decided": 2525, "judged": 2500, "abstained": 2161, "photons_known": 2500}
    figures = {"accuracy": 0.8016, "clicks_mean": 5.33, "photons_mean": 9.0, "illumination": 51.2}
    counted = replace(summary, figures_of=of, **figures, **counts)
    said = closing_words(counted, "r", "s").splitlines()
    assert "4686 decisions, 2161 abstained (" in said[0]
    assert said[1] == "  accuracy      80.16% at 5.33 clicks, 9.00 photons, illumination 51.2 each"
    assert said[2].strip() == "of the 2,500 decisions with a label and a known true class"
    # an automaton's light is known of all decisions alone: it stands on a line of its own
    walked = replace(counted, figures_of=of | {"illumination": "decisions"})
    said = closing_words(walked, "r", "s").splitlines()
    assert said[1] == "  accuracy      80.16% at 5.33 clicks, 9.00 photons each"
    assert said[3] == "  illumination  51.2 each, of all 4,686 decisions"
    write_markdown(tmp_path / "s.md", counted, {}, np.zeros((3, 3), np.int64), ("a", "b", "c"))
    assert "| accuracy | 80.16% | of the 2,500 decisions with a label" in (tmp_path / "s.md").read_text()
    whole = dict.fromkeys(("decided", "judged", "photons_known"), 4686)
    assert "of the" not in closing_words(replace(counted, abstained=0, **whole), "r", "s")


def test_a_quantile_of_too_few_decisions_is_not_printed(summary: Summary, tmp_path: Path) -> None:
    row = {"p50": 120.0, "p99": None, "p999": None, "max": 900.0}
    few = replace(summary, latency_us=row, stage_latency_us={"link": row})
    assert "latency       p50 120 us, max 900 us; late" in closing_words(few, "r", "s")
    write_markdown(tmp_path / "s.md", few, {}, np.zeros((3, 3), np.int64), ("a", "b", "c"))
    assert "| link | 120 | – | – | 900 |" in (tmp_path / "s.md").read_text()


def test_an_accuracy_has_an_interval_also_where_all_were_right() -> None:
    facts = {"accuracy": 1.0, "objects": 3, "accuracy_stderr_objects": 0.0}
    low, high = accuracy_interval(facts) or (0.0, 0.0)
    assert (round(low, 4), high) == (0.4385, 1.0)  # Wilson 1927: n / (n + z^2)
    # objects that are right every time or never tell no more however often they are shown, others do
    sure = accuracy_interval({"accuracy": 0.8, "objects": 200, "accuracy_stderr_objects": 0.4 / 199**0.5})
    broken = accuracy_interval({"accuracy": 0.8, "objects": 200, "accuracy_stderr_objects": 0.4 / 1000**0.5})
    errors = [(high - low) / 2 / 1.96 for low, high in filter(None, (sure, broken))]
    assert errors == pytest.approx([0.4 / 200**0.5, 0.4 / 1000**0.5], rel=0.01)
    assert accuracy_interval({"accuracy": None, "objects": 0}) is None


@pytest.mark.parametrize(
    ("late", "causes", "waited_ms", "lost", "may_be_busy", "busy"),
    [
        (6, {"link": 6}, 400, 0, True, True),
        (6, {"host": 3, "link": 3}, 0, 0, True, True),
        (6, {"link": 6}, 400, 0, False, False),  # a run that is no demo
        (6, {"link": 6}, 0, 0, True, False),  # nothing shows that the host was busy
        (11, {"host": 11}, 400, 0, True, False),  # too many
        (6, {"host": 6}, 400, 1, True, False),  # and something else is wrong
    ],
)
def test_a_demo_on_a_busy_computer_passes_and_says_so(
    late: int, causes: dict[str, int], waited_ms: int, lost: int, may_be_busy: bool, busy: bool, tmp_path: Path
) -> None:
    result = record_small(tmp_path / "run.pansrec", 200)
    result.timing.late, result.late_cause, result.page_faults = late, causes, {"waited_ms": waited_ms}
    result.stream["lost_exposures"], result.seconds = lost, 6.0
    found = summarise(result, illumination=1.0, expected_decisions=200, may_be_busy=may_be_busy)
    assert (found.verdict, bool(found.busy), found.too_late) == (
        ("PASS", True, False) if busy else ("FAIL", False, True)
    )
    assert (_exit_code(found) == 0) == busy
    words = closing_words(replace(found, device=found.device | {"virtual_time": False}), "r", "s")
    said = re.match(
        r"SIMULATED · PASS, but 6 of 200 late: this computer is busy \(load [\d.]+ on \d+ cores\): 200", words
    )
    assert (said is not None) == busy
