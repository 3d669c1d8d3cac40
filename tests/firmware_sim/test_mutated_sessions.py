"""Mutated fields in whole sessions: each contradiction is a fault with its name; tests/slow/test_fields.py draws any others."""

from __future__ import annotations

import functools
import secrets
from pathlib import Path
from typing import Any

import pytest
from mutated_sessions import STAMP, Mutation, Session, Stage

from pans.app.run.one_run import _exit_code

SECOND = 1_000_000  # ticks of the instrument in these sessions
stage = functools.cache(Stage)


def ended(session: Session) -> Any:
    assert session.wrong == []
    assert session.changed > 0
    assert session.summary is not None, session.error
    return session.summary


@pytest.mark.parametrize(
    "mode", ["sequential", "parallel", "device-driven", "device-driven-counts", "device-driven-detectors"]
)
def test_a_session_without_mutations_passes(mode: str, tmp_path: Path) -> None:
    summary = stage(mode).run(tmp_path, 1).summary
    assert summary is not None
    assert (summary.verdict, summary.contradictions, _exit_code(summary)) == ("PASS", {}, 0)


@pytest.mark.parametrize("mode", ["sequential", "parallel"])
@pytest.mark.parametrize(
    ("message", "name", "change", "what"),
    [
        ("STATUS", "next_exposure", {"to": 10**12}, "claimed_exposures"),
        ("STATUS", "drops", {"to": 2**32 - 1}, "claimed_drops"),
        ("STATUS", "state", {"to": 77}, "malformed"),
        ("BLOCK", "drops", {"to": 2**32 - 1}, "drops"),
        ("BLOCK", "count", {"to": 0}, "malformed"),
        ("BLOCK", "tick", {"by": 100 * SECOND}, "future_tick"),
        ("BLOCK", "tick", {"by": -100 * SECOND}, "early"),
        ("BLOCK", "object_index", {"by": 17}, "object"),
        ("BLOCK", "period_ticks", {"by": 1}, "period"),
        ("MARK", "object_index", {"by": 17}, "mark_object"),
        ("MARK", "photons", {"to": -4.0}, "malformed"),
        ("MARK", "truth", {"to": 3}, "truth"),
        # those before ARM must be right, or the device counts as one without a clock
        ("PONG", "host_ns", {"by": 1, "first": 16}, "implausible_answers"),
    ],
)
def test_what_contradicts_the_evidence_is_a_fault_with_its_name(
    message: str, name: str, change: dict[str, Any], what: str, mode: str, tmp_path: Path
) -> None:
    block = {"sequential": "CLICKS", "parallel": "FRAMES"}[mode]
    mutation = Mutation(block if message == "BLOCK" else message, name, **change)
    summary = ended(stage(mode).run(tmp_path, secrets.randbelow(1000), mutation))
    assert summary.verdict == "FAIL"
    assert what in summary.contradictions, summary.faults
    assert any("contradict" in fault for fault in summary.faults)
    assert _exit_code(summary) in (3, 4)


@pytest.mark.parametrize("change", [{"to": 0}, {"to": 6}, {"to": 0xFFFE}, {"to": 0xFFFF}, {"by": 1}], ids=str)
def test_a_state_that_the_walk_does_not_pass_is_a_fault_and_decides_nothing(
    change: dict[str, int], tmp_path: Path
) -> None:
    """Block after block says another first state; those blocks begin with a dark slot, or in the midst of a walk."""
    summary = ended(stage("device-driven").run(tmp_path, secrets.randbelow(1000), Mutation(STAMP, "pattern", **change)))
    assert summary.verdict == "FAIL"
    assert summary.wrong_patterns > 0 or summary.contradictions["stamp"] > 0


@pytest.mark.parametrize("mode", ["sequential", "parallel", "device-driven"])
def test_the_largest_ticks_are_taken_and_replayed(mode: str, tmp_path: Path) -> None:
    """The end of such a block lies beyond 63 bits: no kernel holds it."""
    block = "FRAMES" if mode == "parallel" else "CLICKS"
    for tick in (1 << 62, (1 << 63) - 1):
        assert ended(stage(mode).run(tmp_path, 1, Mutation(block, "tick", tick, most=3))).verdict == "FAIL"


def test_a_device_that_follows_another_automaton_is_found(tmp_path: Path) -> None:
    session = stage("device-driven").run(
        tmp_path, 3, Mutation("STATE", "next_click", 4)
    )  # of state 0, which leads to 2
    summary = ended(session)
    assert (summary.verdict, summary.as_json()["abstained"] > 0, summary.wrong_patterns > 0) == ("FAIL", True, True)


@pytest.mark.parametrize("mutation", [Mutation("COUNTS", "largest", 4), Mutation(STAMP, "pattern", 5)], ids=str)
def test_blocks_of_several_detectors_that_cannot_be_of_this_run_decide_nothing(
    mutation: Mutation, tmp_path: Path
) -> None:
    """They say numbers up to 4 in place of 3, or state after state that the walk does not pass."""
    summary = ended(stage("device-driven-detectors").run(tmp_path, secrets.randbelow(1000), mutation))
    assert summary.verdict == "FAIL"
    assert summary.as_json()["decisions"] == summary.as_json()["abstained"]


@pytest.mark.parametrize(
    ("mode", "message", "name", "value", "words"),
    [
        ("device-driven-detectors", "READ_COUNTS", "channels", 3, "3 detectors at once: the device reads 2"),
        ("device-driven-detectors", "READ_COUNTS", "largest", 2, "numbers up to 2 of 2 detectors: allowed 3"),
        ("device-driven-detectors", "LOAD_COUNT_STATES", "outcomes", 3, "LOAD_COUNT_STATES"),
        ("device-driven-detectors", "COUNT_STATE", "pattern", 3, "a state shows pattern 3"),
        ("device-driven", "STATE", "next_dark", 0, "state 0 leads to 0"),
        ("device-driven", "STATE", "pattern", 4, "a state shows pattern 4"),
        ("device-driven", "LOAD_STATES", "dwell_steps", 3, "dwell in 3 steps"),
        ("device-driven", "LOAD_STATES", "n_states", 17, "17 states: the device follows 16"),
        ("device-driven", "LOAD_MASKS", "n_pixels", 5, "LOAD_MASKS holds"),
        ("device-driven", "WELCOME", "map.automaton_schema", 7, "automata of schema 0x00000007"),
        ("device-driven", "WELCOME", "map.automaton_states", 5, "up to 5 states, needed 6"),
        ("device-driven", "WELCOME", "map.dwell_steps", 0, "dwell_steps is 0, allowed 1 to 65535"),
        ("sequential", "WELCOME", "map.tick_hz", "1000000", "tick_hz"),
        ("sequential", "WELCOME", "map.tick_hz", 0, "tick_hz"),
        ("sequential", "WELCOME", "map.channels", float("nan"), "channels"),
        ("sequential", "WELCOME", "map.epoch", 1 << 63, "epoch"),
        ("sequential", "WELCOME", "map.simulated", "no", "simulated"),
    ],
)
def test_what_cannot_be_done_or_meant_is_refused_with_the_reason(
    mode: str, message: str, name: str, value: Any, words: str, tmp_path: Path
) -> None:
    session = stage(mode).run(tmp_path, 1, Mutation(message, name, value))
    assert session.wrong == []
    assert session.error.startswith("DeviceError")
    assert words in session.error


def test_a_run_that_is_refused_before_its_first_exposure_can_be_read(tmp_path: Path) -> None:
    session = Stage("sequential").run(tmp_path, 1, Mutation("ARM", "n_cycles", 1 << 63))
    assert not session.wrong
    assert session.summary is not None
    assert session.summary.as_json()["seconds"] == 0


def test_a_device_that_never_ends_its_plan_does_not_keep_the_host(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pans.live.loop.SILENCE_NS", 10**8)  # seconds of a fast device are a million exposures
    summary = ended(stage("sequential").run(tmp_path, 1, Mutation("ARM", "n_cycles", by=1_000_000)))
    assert summary.ended == "the device goes on beyond its plan"
    assert (summary.verdict, _exit_code(summary)) == ("FAIL", 4)
