"""What a live run notes beside its clicks: events, the session it belongs to, the clock's probes and jumps, refused gates.

A short list of events is for the summary; all of them go into the recording, where there is one.
"""

from __future__ import annotations

import logging
from collections import Counter
from typing import Any

from pans.base.console import log_event
from pans.decide import CoreEvent
from pans.protocol.session import Refusal
from pans.protocol.wire import Opcode
from pans.record.recorder import Recorder

from .session import Session

MAX_EVENTS = 1000  # of the summary; the recording has them all
MAX_OF_A_KIND = 200  # so that many late decisions leave room for their verdicts
TROUBLE = (
    *("blame", "gap", "link_lost", "clock_step", "gate_refused", "show_refused", "parts_trouble"),
    *("beyond_plan", "contradiction", "disk_short", "disk_nearly_full", "recording_deleted", "host_clock_step"),
    "light_changed",
)


def words_of(event: dict[str, Any]) -> str:
    """Return why an event happened, in its own words, or its facts; of late or missing work the cause, how sure it is, and where."""
    found = next((str(event[key]) for key in ("why", "reason", "message", "text", "words") if event.get(key)), "")
    found = found or ", ".join(f"{key} {value}" for key, value in event.items() if key != "kind")
    if event["kind"] != "blame":
        return found
    first = event.get("first_decision")
    where = "" if first is None else f" (from decision {first})"
    return f"{event['cause']}{'' if event['sure'] else ', not certain'}: {found}{where}"


class Journal:
    """The notes of one run, across reconnections."""

    def __init__(self, recorder: Recorder | None) -> None:
        self.events: list[dict[str, Any]] = []
        self.trouble: dict[str, Any] | None = None  # the latest
        self.recorder = recorder
        self.counts: Counter[str] = Counter()  # of all notes, by kind

    def take(self, event: CoreEvent) -> None:
        """Note what a core or a verdict tells."""
        self.note(**event.event())

    def note(self, kind: str, **facts: Any) -> None:
        """Note one event: its kind and what belongs to it, units in the names."""
        event = {"kind": kind, **facts}
        troubles = kind in TROUBLE or facts.get("level") in ("warning", "alarm")  # the dark counts' have levels
        if troubles:
            self.trouble = event
        log_event(kind, facts, logging.WARNING if troubles else logging.INFO)
        self.counts[kind] += 1
        if len(self.events) < MAX_EVENTS and self.counts[kind] <= MAX_OF_A_KIND:
            self.events.append(event)
        if self.recorder is not None:
            self.recorder.add_event(event)

    def session(self, session: Session) -> None:
        """Note which session and device clock the following ticks belong to."""
        self.note("session", nonce=session.host.nonce, epoch=str(session.facts.get("epoch", "unknown")))
        self.clock(session)

    def clock(self, session: Session) -> None:
        """Note the probes and the jumps of the device's clock since the last time."""
        for step in session.clock_steps:
            self.note("clock_step", tick=step.tick, off_ns=step.off_ns, allowed_ns=step.allowed_ns)
        session.clock_steps.clear()
        samples = session.known_clock().take_samples()
        if self.recorder is not None and len(samples):
            self.recorder.add_clock(samples)

    def refusals(self, session: Session) -> None:
        """Note the pulses and the names of states that the device has refused."""
        refusals = session.host.refusals
        while refusals:
            self.refused(refusals.popleft())

    def refused(self, refusal: Refusal) -> None:
        """Note a command that the device has refused, and that nobody waits for."""
        kind = "show_refused" if refusal.opcode == Opcode.SHOW else "gate_refused"
        self.note(kind, command_id=refusal.command_id, status=refusal.status, text=refusal.text)
