"""When a live run wakes because a block is overdue, and asks the device; live/timing/causes.py judges what made work late."""

from __future__ import annotations

from functools import partial

from pans.decide.plan import Plan
from pans.live.session import Session
from pans.protocol.links import Link
from pans.protocol.tracker import Gap
from pans.record.recorder import Recorder

from .causes import DISK, NS_PER_S, Attribution, Evidence, Incidents, longest_pause_ns

POLL_S = 0.02
LEAST_SLACK_NS = 500_000
LEAST_WAIT_S = 0.0002


class Lateness:
    """The evidence of one run, across reconnections; `attach` before each ARM."""

    def __init__(self, plan: Plan, deadline_ns: int, link: Link, recorder: Recorder | None) -> None:
        pause_ns = longest_pause_ns(plan)
        self.evidence = Evidence(link.now_ns, deadline_ns, pause_ns=pause_ns, virtual=link.virtual)
        self.incidents = Incidents(self.evidence)
        self.block_ns = 0  # when the latest block came
        self._patience_ns = pause_ns + max(deadline_ns // 2, LEAST_SLACK_NS)
        self._asked = True  # the device, in the silence under way
        self._damaged = 0
        if recorder is not None and not link.virtual:
            recorder.watch_write = partial(self.evidence.worked, DISK)

    def attach(self, session: Session, start_ns: int, deciding: int | None) -> None:
        """Take evidence from `session`, and of the thread that decides, from here on; its exposures begin at `start_ns`."""
        session.evidence = self.evidence
        self.evidence.watch(session.reader.thread_id, deciding)
        self.block_ns, self._asked, self._damaged = start_ns, False, 0

    def poll_s(self, now_ns: int) -> float:
        """How long to wait for bytes: until the next block is overdue. Waking then shows that the host was awake."""
        if self._asked:
            return POLL_S
        return min(POLL_S, max((self.block_ns + self._patience_ns - now_ns) / NS_PER_S, LEAST_WAIT_S))

    @property
    def patience_ns(self) -> int:
        """How long after a block the next one is overdue; 0 where the device has been asked already."""
        return 0 if self._asked else self._patience_ns

    @property
    def longest_ns(self) -> int:
        """How long after a block the next one is overdue."""
        return self._patience_ns

    def block_came(self, arrival_ns: int) -> None:
        """Note that the stream goes on."""
        self.block_ns, self._asked = arrival_ns, False

    def ask_if_overdue(self, session: Session, block_ns: int, now_ns: int) -> bool:
        """Probe the link, once in a silence, where the block behind that of `block_ns` is overdue; return whether that was done."""
        overdue = not self._asked and now_ns >= block_ns + self._patience_ns
        if overdue:
            session.host.probe(now_ns)
            self._asked = True
        return overdue

    def lost(self, gap: Gap, session: Session, now_ns: int) -> Attribution:
        """Return the verdict on exposures that never came."""
        counters = session.decoder.counters
        damaged = counters.crc_errors + counters.cobs_errors + counters.short_frames + counters.oversized_frames
        attribution = self.incidents.lost(gap, min(self.block_ns, now_ns), now_ns, damaged - self._damaged)
        self._damaged = damaged
        return attribution

    def settled(self, session: Session, now_ns: int, *, idle: bool) -> Attribution | None:
        """Do what is due after a turn that brought something, or nothing (`idle`); return a verdict that is ready."""
        if idle:
            self.ask_if_overdue(session, self.block_ns, now_ns)
        self.evidence.read_if_stale(now_ns)
        return self.incidents.verdict(now_ns)
