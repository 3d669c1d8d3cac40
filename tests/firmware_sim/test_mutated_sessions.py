"""Mutated fields in whole sessions: each contradiction is a fault with its name; tests/slow/test_fields.py draws any others."""

from __future__ import annotations

import secrets
from pathlib import Path
from typing import Any

import pytest
from mutated_sessions import STAMP, Mutation, Session, Stage, by, to

from pans.runtime.commands.one_run import _exit_code

SECOND = 1_000_000  # ticks of the instrument in these sessions


@pytest.fixture(scope="module")
def stage() -> Stage:
    return Stage("sequential")


@pytest.fixture(scope="module")
def parallel() -> Stage:
    return Stage("parallel")


@pytest.fixture(scope="module")
def walks() -> Stage:
    return Stage("device-driven")


@pytest.fixture(scope="module")
def detectors() -> Stage:
    return Stage("device-driven-detectors")


def ended(session: Session) -> Any:
    assert session.wrong == []
    assert session.changed > 0
    assert session.summary is not None, session.error
    return session.summary


def refused(session: Session, words: str) -> None:
    assert session.wrong == []
    assert session.error.startswith("DeviceError")
    assert words in session.error


def test_a_session_without_mutations_passes(
    stage: Stage, parallel: Stage, walks: Stage, detectors: Stage, tmp_path: Path
) -> None:
    for one in (stage, parallel, walks, detectors, Stage("device-driven-counts")):
        summary = one.run(tmp_path, 1).summary
        assert summary is not None
        assert (summary.verdict, summary.contradictions, _exit_code(summary)) == ("PASS", {}, 0)


CASES = {
    "10^12 exposures claimed": ("STATUS", "next_exposure", to(10**12), "claimed_exposures"),
    "2^32 - 1 drops claimed": ("STATUS", "drops", to(2**32 - 1), "claimed_drops"),
    "drops without anything missing": ("BLOCK", "drops", to(2**32 - 1), "drops"),
    "malformed blocks": ("BLOCK", "count", to(0), "malformed"),
    "malformed answers": ("STATUS", "state", to(77), "malformed"),
    "ticks 100 s in the future": ("BLOCK", "tick", by(100 * SECOND), "future_tick"),
    "ticks 100 s in the past": ("BLOCK", "tick", by(-100 * SECOND), "early"),
    "other objects": ("BLOCK", "object_index", by(17), "object"),
    "marks of other objects": ("MARK", "object_index", by(17), "mark_object"),
    "negative photons": ("MARK", "photons", to(-4.0), "malformed"),
    "a class that there is not": ("MARK", "truth", to(3), "truth"),
    "another spacing": ("BLOCK", "period_ticks", by(1), "period"),
    "echoes of other probes": ("PONG", "host_ns", by(1), "implausible_answers"),
}


@pytest.mark.parametrize("mode", ["sequential", "parallel"])
@pytest.mark.parametrize("case", CASES)
def test_what_contradicts_the_evidence_is_a_fault_with_its_name(
    case: str, mode: str, stage: Stage, parallel: Stage, tmp_path: Path
) -> None:
    message, name, (change, words), what = CASES[case]
    block = {"sequential": "CLICKS", "parallel": "FRAMES"}[mode]
    message = block if message == "BLOCK" else message
    first = (
        16 if message == "PONG" else 0
    )  # those before ARM must be right, or the device counts as one without a clock
    one = stage if mode == "sequential" else parallel
    summary = ended(one.run(tmp_path, secrets.randbelow(1000), Mutation(message, name, change, words, first)))
    assert summary.verdict == "FAIL"
    assert what in summary.contradictions, summary.faults
    assert any("contradict" in fault for fault in summary.faults)
    assert _exit_code(summary) in (3, 4)


@pytest.mark.parametrize("change", [to(0), to(6), to(0xFFFE), to(0xFFFF), by(1)], ids=lambda change: change[1])
def test_a_state_that_the_walk_does_not_pass_is_a_fault_and_decides_nothing(
    change: Any, walks: Stage, tmp_path: Path
) -> None:
    """Block after block says another first state; those blocks begin with a dark slot, or in the midst of a walk."""
    mutation = Mutation(STAMP, "pattern", *change)
    summary = ended(walks.run(tmp_path, secrets.randbelow(1000), mutation))
    assert summary.verdict == "FAIL"
    assert summary.wrong_patterns > 0 or summary.contradictions["stamp"] > 0


@pytest.mark.parametrize("mode", ["sequential", "parallel", "device-driven"])
def test_the_largest_ticks_are_taken_and_replayed(
    mode: str, stage: Stage, parallel: Stage, walks: Stage, tmp_path: Path
) -> None:
    """The end of such a block lies beyond 63 bits: no kernel holds it."""
    one = {"sequential": stage, "parallel": parallel, "device-driven": walks}[mode]
    block = "FRAMES" if mode == "parallel" else "CLICKS"
    for tick in (1 << 62, (1 << 63) - 1):
        assert ended(one.run(tmp_path, 1, Mutation(block, "tick", *to(tick), most=3))).verdict == "FAIL"


def test_a_device_that_follows_another_automaton_is_found(walks: Stage, tmp_path: Path) -> None:
    session = walks.run(tmp_path, 3, Mutation("STATE", "next_click", *to(4)))  # of state 0, which leads to 2
    summary = ended(session)
    assert (summary.verdict, summary.as_json()["abstained"] > 0, summary.wrong_patterns > 0) == ("FAIL", True, True)


@pytest.mark.parametrize("message", ["COUNTS", STAMP])
def test_blocks_of_several_detectors_that_cannot_be_of_this_run_decide_nothing(
    message: str, detectors: Stage, tmp_path: Path
) -> None:
    """They say numbers up to 4 in place of 3, or state after state that the walk does not pass."""
    mutation = Mutation(message, *{"COUNTS": ("largest", *to(4)), STAMP: ("pattern", *to(5))}[message])
    summary = ended(detectors.run(tmp_path, secrets.randbelow(1000), mutation))
    assert summary.verdict == "FAIL"
    assert summary.as_json()["decisions"] == summary.as_json()["abstained"]


@pytest.mark.parametrize(
    ("mutation", "words"),
    [
        (Mutation("READ_COUNTS", "channels", *to(3)), "3 detectors at once: the device reads 2"),
        (Mutation("READ_COUNTS", "largest", *to(2)), "numbers up to 2 of 2 detectors: allowed 3"),
        (Mutation("LOAD_COUNT_STATES", "outcomes", *to(3)), "LOAD_COUNT_STATES"),
        (Mutation("COUNT_STATE", "pattern", *to(3)), "a state shows pattern 3"),
    ],
    ids=str,
)
def test_what_a_device_of_two_detectors_cannot_read_is_refused_with_the_reason(
    mutation: Mutation, words: str, detectors: Stage, tmp_path: Path
) -> None:
    refused(detectors.run(tmp_path, 1, mutation), words)


@pytest.mark.parametrize(
    ("mutation", "words"),
    [
        (Mutation("STATE", "next_dark", *to(0)), "state 0 leads to 0"),
        (Mutation("STATE", "pattern", *to(4)), "a state shows pattern 4"),
        (Mutation("LOAD_STATES", "dwell_steps", *to(3)), "dwell in 3 steps"),
        (Mutation("LOAD_STATES", "n_states", *to(17)), "17 states: the device follows 16"),
        (Mutation("LOAD_MASKS", "n_pixels", *to(5)), "LOAD_MASKS holds"),
        (Mutation("WELCOME", "map.automaton_schema", *to(7)), "automata of schema 0x00000007"),
        (Mutation("WELCOME", "map.automaton_states", *to(5)), "up to 5 states, needed 6"),
        (Mutation("WELCOME", "map.dwell_steps", *to(0)), "dwell_steps is 0, allowed 1 to 65535"),
    ],
    ids=str,
)
def test_what_a_device_cannot_follow_is_refused_with_the_reason(
    mutation: Mutation, words: str, walks: Stage, tmp_path: Path
) -> None:
    refused(walks.run(tmp_path, 1, mutation), words)


@pytest.mark.parametrize(
    ("name", "value"),
    [("tick_hz", "1000000"), ("tick_hz", 0), ("channels", float("nan")), ("epoch", 1 << 63), ("simulated", "no")],
)
def test_a_welcome_that_cannot_be_meant_is_refused(name: str, value: Any, stage: Stage, tmp_path: Path) -> None:
    refused(stage.run(tmp_path, 1, Mutation("WELCOME", f"map.{name}", *to(value))), name)


def test_a_device_that_never_ends_its_plan_does_not_keep_the_host(
    stage: Stage, parallel: Stage, tmp_path: Path
) -> None:
    for one in (stage, parallel):
        summary = ended(one.run(tmp_path, 1, Mutation("ARM", "n_cycles", *by(1_000_000))))
        assert summary.ended == "the device goes on beyond its plan"
        assert (summary.verdict, _exit_code(summary)) == ("FAIL", 4)
