"""What a live run does about late work: wakes when a block is overdue, asks the device then, and closes incidents with a verdict.

Evidence and judgement are in timing/causes.py; late decisions are counted by timing/ledger.py.
`settled` returns the verdicts that are ready as events for the recording. Costs a block one comparison and one short call.
"""

from __future__ import annotations

from pans.runtime.core.plan import Plan
from pans.runtime.link.base import Link
from pans.runtime.link.connection import Connection
from pans.runtime.record import Recorder
from pans.runtime.timing.causes import (
    DISK,
    INFERENCE,
    NS_PER_S,
    Attribution,
    Evidence,
    Incidents,
    LateWork,
    Stamped,
    longest_pause_ns,
)
from pans.runtime.wire.messages import Status
from pans.runtime.wire.tracker import Gap

POLL_S = 0.02
LEAST_SLACK_NS = 500_000
LEAST_WAIT_S = 0.0002


class Lateness:
    """The evidence of one run, across reconnections; `attach` before each ARM, `close` at the end."""

    def __init__(self, plan: Plan, deadline_ns: int, link: Link, recorder: Recorder | None) -> None:
        pause_ns = longest_pause_ns(plan)
        self.evidence = Evidence(link.now_ns, deadline_ns, pause_ns=pause_ns, virtual=link.virtual)
        self.incidents = Incidents(self.evidence)
        self.block_ns = 0  # when the latest block came
        self._patience_ns = pause_ns + max(deadline_ns // 2, LEAST_SLACK_NS)
        self._asked = True  # the device, in the silence under way
        self._damaged = 0
        if recorder is not None and not link.virtual:
            recorder.watch_write = self._wrote

    def attach(self, connection: Connection, start_ns: int) -> None:
        """Take evidence from `connection` from here on; its exposures begin at `start_ns`."""
        connection.evidence = self.evidence
        self.evidence.watch(connection.reader.thread_id)
        self.block_ns, self._asked, self._damaged = start_ns, False, 0

    def close(self) -> None:
        """Stop taking evidence; idempotent."""
        self.evidence.close()

    # -- during a turn -------------------------------------------------------------------------------------------------

    def poll_s(self, now_ns: int) -> float:
        """How long to wait for bytes: until the next block is overdue. Waking then shows that the host was awake."""
        if self._asked:
            return POLL_S
        return min(POLL_S, max((self.block_ns + self._patience_ns - now_ns) / NS_PER_S, LEAST_WAIT_S))

    @property
    def patience_ns(self) -> int:
        """How long after a block the next one is overdue; 0 where the device has been asked already."""
        return 0 if self._asked else self._patience_ns

    def stepped(self, begin_ns: int, end_ns: int) -> None:
        """Note how long the core took over one frame."""
        self.evidence.worked(INFERENCE, begin_ns, end_ns)

    def block_came(self, arrival_ns: int) -> None:
        """Note that the stream goes on."""
        self.block_ns, self._asked = arrival_ns, False

    def status_came(self, connection: Connection, status: Status, arrival_ns: int) -> None:
        """Note a STATUS: it says when it left the device."""
        left_ns, _ = connection.known_clock().to_host_ns(status.tick)
        self.evidence.stamped(Stamped(None, None, left_ns, arrival_ns))

    def late(self, number: int, begin_ns: int, arrival_ns: int, decided_ns: int) -> None:
        """Take a late decision with its times, as the ledger judged them."""
        self.incidents.late(LateWork(number, begin_ns, arrival_ns, decided_ns))

    def lost(self, gap: Gap, connection: Connection, now_ns: int) -> Attribution:
        """Return the verdict on exposures that never came."""
        counters = connection.decoder.counters
        damaged = counters.crc_errors + counters.cobs_errors + counters.short_frames + counters.oversized_frames
        attribution = self.incidents.lost(gap, min(self.block_ns, now_ns), now_ns, damaged - self._damaged)
        self._damaged = damaged
        return attribution

    def settled(self, connection: Connection, now_ns: int, *, idle: bool) -> Attribution | None:
        """Do what is due after a turn that brought something, or nothing (`idle`); return a verdict that is ready."""
        if idle and not self._asked and now_ns >= self.block_ns + self._patience_ns:
            connection.session.probe(now_ns)  # is the link open while the block is overdue?
            self._asked = True
        self.evidence.read_if_stale(now_ns)
        return self.incidents.verdict(now_ns)

    def closing_verdicts(self, now_ns: int) -> list[Attribution]:
        """Return the verdicts on what the end of the run cuts short."""
        return list(iter(lambda: self.incidents.verdict(now_ns, final=True), None))

    def _wrote(self, begin_ns: int, end_ns: int) -> None:
        self.evidence.worked(DISK, begin_ns, end_ns)
