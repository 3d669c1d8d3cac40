"""What the host of a watched run does besides the ordinary run: it asks for gates, some of them too late, and watches memory.

Owns the taps on what is asked of the device; the order of the run is run_live's, and what must hold the checker's.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from pans.runtime.core.decision import Output
from pans.runtime.live import LiveRun
from pans.runtime.live.flow_run import FlowRun
from pans.runtime.wire.commands import unpack_gate
from pans.runtime.wire.messages import Opcode
from pans.runtime.wire.session import HostSession

from .checkers import Checker

GATE_EVERY = 32  # decisions
FAR_TICKS, NEAR_TICKS = 4_000_000, 50  # 40 ms at 100 MHz, longer than any read takes; what often comes too late
MEMORY_SLACK_KB = 16_384


class GridHost:
    """What the grid does besides the ordinary run: it asks for gates, some of them too late, and watches memory."""

    def __init__(self, checker: Checker, frames: int, flow: FlowRun | None = None) -> None:
        self.checker = checker
        self.memory_growth_kb = 0
        self._flow = flow
        self._decisions = 0
        self._frames = frames
        self._early_kb = 0
        self._run: LiveRun | None = None

    @property
    def began(self) -> bool:
        """Whether the run has come to where it arms the device."""
        return self._run is not None

    def start(self, run: LiveRun) -> None:
        """Listen to the run, and to each session of it from before it is armed."""
        self._run = run
        if self._flow is not None:
            self._flow.prepared(run)
        self.checker.attach(run)
        note, arm = run.journal.note, run.arm

        def tapped(kind: str, **facts: Any) -> None:
            self.checker.on_event(run.connection.session.nonce, {"kind": kind, **facts})
            note(kind, **facts)

        def tapped_arm() -> None:
            self._listen(run.connection.session)
            arm()

        for owner, name, tap in ((run.journal, "note", tapped), (run, "arm", tapped_arm)):
            setattr(owner, name, tap)

    def _listen(self, session: HostSession) -> None:
        submit = session.submit

        def tapped(opcode: Opcode, body: bytes = b"", **how: bool) -> int:
            if opcode == Opcode.GATE:
                self.checker.submitted(session.nonce, session.next_id, unpack_gate(body))
            return submit(opcode, body, **how)

        session.submit = tapped  # type: ignore[method-assign]

    def watch(self, run: LiveRun, output: Output) -> None:
        """After each block, or many of them: now and then a gate, and a look at the memory."""
        if not self._early_kb and self.checker.counts.blocks_delivered > self._frames // 5:
            self._early_kb = resident_kb()
        before, self._decisions = self._decisions, self._decisions + len(output.decisions)
        if output.block_end_tick is None:
            return
        for number in range(before // GATE_EVERY + 1, self._decisions // GATE_EVERY + 1):
            # every other gate is so near that it often comes too late; the duration makes each one unique
            if run.connection.session.has_room:
                run.gate(output.block_end_tick + (NEAR_TICKS if number % 2 else FAR_TICKS), 1 + number, 0)

    def finish(self, ended: str) -> None:
        """After the run: commands that were all acknowledged have one outcome each."""
        assert self._run is not None
        session = self._run.connection.session
        if session.settled and not self._run.link_lost:
            self._run.journal.refusals(self._run.connection)
            self.checker.settled(session.nonce, 1 << 32)
        if ended not in ("completed", "the link was lost within the last object"):
            self.checker.fail(f"the run did not complete: {ended}")
        self.memory_growth_kb = resident_kb() - self._early_kb if self._early_kb else 0
        if self.memory_growth_kb > MEMORY_SLACK_KB:
            self.checker.fail(f"the process grew by {self.memory_growth_kb} kB over the run")


def resident_kb() -> int:
    """Return the resident memory of this process in kB; 0 where the system does not tell."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 1024
    except (OSError, ValueError):
        return 0
