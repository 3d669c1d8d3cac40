"""Mutated fields in whole sessions: the cases that once passed against the evidence, and a short run of any others."""

from __future__ import annotations

import json
import secrets
from pathlib import Path
from typing import Any

import pytest

from pans.firmware_sim.trials.fields import Mutation, Session, Stage, by, sessions, to
from pans.runtime.cli import main
from pans.runtime.commands.carry_out import _exit_code

ALL = 1 << 30
SECOND = 1_000_000  # ticks of the instrument in these sessions


@pytest.fixture(scope="module")
def stage() -> Stage:
    return Stage("sequential")


@pytest.fixture(scope="module")
def parallel() -> Stage:
    return Stage("parallel")


def ended(session: Session) -> Any:
    assert session.wrong == []
    assert session.changed > 0
    assert session.summary is not None, session.error
    return session.summary


def test_a_session_without_mutations_passes(stage: Stage, parallel: Stage, tmp_path: Path) -> None:
    for one in (stage, parallel):
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


@pytest.mark.parametrize(
    ("name", "value"),
    [("tick_hz", "1000000"), ("tick_hz", 0), ("channels", float("nan")), ("epoch", 1 << 63), ("simulated", "no")],
)
def test_a_welcome_that_cannot_be_meant_is_refused(name: str, value: Any, stage: Stage, tmp_path: Path) -> None:
    session = stage.run(tmp_path, 1, Mutation("WELCOME", f"map.{name}", *to(value)))
    assert session.wrong == []
    assert session.error.startswith("DeviceError")
    assert name in session.error


def test_any_field_of_any_message_is_taken_or_refused_without_a_traceback() -> None:
    seed = secrets.randbelow(1 << 40)
    _, wrong = sessions(seed, 30)
    assert wrong == [], f"sessions({seed}, 30)"


def test_the_command_reports_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fuzz", "--fields", "8", "--seed", str(secrets.randbelow(1 << 40)), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert (figures["sessions"], figures["failed_seed"]) == (8, None)


def test_over_a_socket_in_real_time_the_host_finds_the_same(tmp_path: Path) -> None:
    stage = Stage("sequential", "tcp")
    session = stage.run(tmp_path, 1, Mutation("CLICKS", "object_index", *by(17), most=1))
    assert "object" in ended(session).contradictions
