"""What a live run notes beside its clicks: events, the session it belongs to, the clock's probes and jumps, refused gates.

A short list of events is for the summary; all of them go into the recording, where there is one.
"""

from __future__ import annotations

import logging
from collections import Counter
from typing import Any

from pans.runtime.core.decision import CoreEvent
from pans.runtime.errors import LinkError
from pans.runtime.link.connection import Connection
from pans.runtime.logs import log_event
from pans.runtime.record import Recorder
from pans.runtime.wire.messages import Opcode
from pans.runtime.wire.session import Refusal

MAX_EVENTS = 1000  # of the summary; the recording has them all
MAX_OF_A_KIND = 200  # so that many late decisions leave room for their verdicts
TROUBLE = (
    *("blame", "gap", "link_lost", "clock_step", "gate_refused", "show_refused"),
    *(
        "parts_trouble",
        "beyond_plan",
        "contradiction",
        "disk_short",
        "disk_nearly_full",
        "recording_deleted",
        "host_clock_step",
    ),
)


class Journal:
    """The notes of one run, across reconnections."""

    def __init__(self, recorder: Recorder | None) -> None:
        self.events: list[dict[str, Any]] = []
        self.trouble: dict[str, Any] | None = None  # the latest
        self.recorder = recorder
        self._kept: Counter[str] = Counter()

    def take(self, event: CoreEvent) -> None:
        """Note what a core or a verdict tells."""
        self.note(**event.event())

    def note(self, kind: str, **facts: Any) -> None:
        """Note one event: its kind and what belongs to it, units in the names."""
        event = {"kind": kind, **facts}
        if kind in TROUBLE:
            self.trouble = event
        log_event(kind, facts, logging.WARNING if kind in TROUBLE else logging.INFO)
        if len(self.events) < MAX_EVENTS and self._kept[kind] < MAX_OF_A_KIND:
            self._kept[kind] += 1
            self.events.append(event)
        if self.recorder is not None:
            self.recorder.add_event(event)

    def session(self, connection: Connection) -> None:
        """Note which session and device clock the following ticks belong to."""
        welcome = connection.session.welcome
        facts = {} if welcome is None else welcome.facts
        self.note("session", nonce=connection.session.nonce, epoch=str(facts.get("epoch", "unknown")))
        self.clock(connection)

    def clock(self, connection: Connection) -> None:
        """Note the probes and the jumps of the device's clock since the last time."""
        for step in connection.clock_steps:
            self.note("clock_step", tick=step.tick, off_ns=step.off_ns, allowed_ns=step.allowed_ns)
        connection.clock_steps.clear()
        samples = connection.known_clock().take_samples()
        if self.recorder is not None and len(samples):
            self.recorder.add_clock(samples)

    def refusals(self, connection: Connection) -> None:
        """Note the pulses and the names of states that the device has refused."""
        refusals = connection.session.refusals
        while refusals:
            self.refused(refusals.popleft())

    def refused(self, refusal: Refusal) -> None:
        """Note a command that the device has refused, and that nobody waits for."""
        kind = "show_refused" if refusal.opcode == Opcode.SHOW else "gate_refused"
        self.note(kind, command_id=refusal.command_id, status=refusal.status, text=refusal.text)


class Reconciled:
    """What `LiveRun` counts across its connections."""

    connection: Connection
    journal: Journal
    decoded: Counter[str]  # what the connections that are gone have counted
    contradictions: Counter[str]  # between messages and the clock, or the host's own books
    failed: list[Connection]  # those that broke before they could be armed
    recorder: Recorder | None
    ended: str
    link_lost: bool
    taken_here: int  # messages of the present connection that the core was given, or came before ARM
    armed: Connection | None = None  # the connection whose session was sent ARM last
    _counted: Connection | None = None

    def lose_link(self, error: LinkError) -> None:
        """End the run because the link is gone; what was decided so far stands."""
        self.ended = self.ended or f"the link was lost: {error.message}"
        self.link_lost = True

    def drop_recorder(self) -> None:
        """Go on without a recording, which cannot be written any further, so that the device can be told to stop."""
        self.recorder = self.journal.recorder = None
        self.connection.on_sent = self.connection.on_answer = None

    def count_decoded(self) -> None:
        """Add up what the present connection's decoder has counted, once: before it goes, or at the end; those that failed too."""
        while self.failed:
            self._add_counters(self.failed.pop())
        if self._counted is not self.connection:
            self._counted = self.connection
            self._add_counters(self.connection)
            self._reconcile(self.connection.decoder.counters.frames)

    def _add_counters(self, connection: Connection) -> None:
        counters, session = connection.decoder.counters, connection.session.counters
        self.decoded.update({name: getattr(counters, name) for name in counters.__slots__})
        self.decoded.update({name: getattr(session, name) for name in ("wrong_session", "unknown_type")})
        self.decoded.update(malformed_answers=session.malformed, implausible_answers=session.implausible)

    def _reconcile(self, frames: int) -> None:
        """Compare the books of the decoder, the connection and this run: every frame is an answer or was taken."""
        lost = frames - self.connection.answers - self.connection.delivered
        untaken = self.connection.delivered - self.taken_here if self.connection is self.armed else 0
        self.taken_here = 0
        for what, count in (("frames_lost_in_host", lost), ("messages_not_taken", untaken)):
            if count:
                self.contradictions[what] += abs(count)
                self.journal.note("contradiction", what=what, found=count, expected=0)
