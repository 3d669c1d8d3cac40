"""What a host that drives an automaton sends: after each exposure the name of the next state (SHOW), at once.

All bodies but their exposure are packed before arming, so that an answer is one look at the walk, one pack and one write.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pans.bundle.automaton import Automaton
from pans.decide.kernel import Drive
from pans.decide.plan import Plan
from pans.decide.still import Core, DecisionWindows
from pans.live.timing.ledger import LatencyHistogram
from pans.protocol.session import COMMAND_WINDOW
from pans.protocol.wire import ADAPTIVE_PATTERN, HEADER, STRUCTS, MessageType, Opcode, Show, pack_command

from .session import Session

CRC_BYTES = 4
_EXPOSURE_BYTES = 8  # of SHOW: the exposure, u64, stands first


class WalkPlace:
    """The slots of one plan's walks, `automaton` that it runs."""

    def __init__(self, plan: Plan, automaton: Automaton) -> None:
        self.automaton = automaton
        adaptive = plan.slot_pattern == ADAPTIVE_PATTERN
        slots = np.flatnonzero(adaptive)
        self._next_step = np.concatenate([[0], np.cumsum(adaptive)]).tolist()  # by slot: steps of the walk before it
        self._slot_of = slots.tolist()
        self._slots, self._walks = plan.slots_per_cycle, plan.cycles_per_object

    def arrays(self, tails: list[bytes], session: int) -> Drive:
        """Return what the kernel drives by, with the `tails` of SHOW by state, in `session`."""
        size = HEADER.size + STRUCTS["COMMAND"].size
        plain: npt.NDArray[np.uint8] = np.zeros(size + _EXPOSURE_BYTES + len(tails[0]) + CRC_BYTES, np.uint8)
        head = HEADER.pack(MessageType.COMMAND, 0, session) + STRUCTS["COMMAND"].pack(0, Opcode.SHOW)
        plain[:size] = np.frombuffer(head, np.uint8)
        return Drive(
            np.array(self._next_step, np.int64),
            np.array(self._slot_of, np.int64),
            np.frombuffer(b"".join(tails), np.uint8).reshape(len(tails), -1).copy(),
            plain,
            np.array([self._slots, self._walks], np.int64),
        )

    def following(self, windows: DecisionWindows, next_exposure: int) -> tuple[int, int]:
        """Return exposure and state of the next step: of the walk under way, or of the next one when this one is over or lost."""
        cycle, slot = divmod(next_exposure, self._slots)
        step = self._next_step[slot]
        if step < len(self._slot_of):
            state = windows.walk_state(cycle // self._walks, cycle % self._walks, step)
            if state >= 0:
                return cycle * self._slots + self._slot_of[step], state
        return (cycle + 1) * self._slots + self._slot_of[0], 0


class HostDriver:
    """Names states to the device of one run, across reconnections: `begin` after each ARM, `turn` after each block."""

    def __init__(self, core: Core, place: WalkPlace) -> None:
        self.turns = LatencyHistogram()  # from the arrival of a block until its SHOW had left
        self._core, self._place = core, place
        automaton = place.automaton
        shown = zip(automaton.pattern.tolist(), automaton.dwell.tolist())
        self._tails = [
            pack_command(Show(0, state, pattern, dwell, automaton.dwell_steps))[_EXPOSURE_BYTES:]
            for state, (pattern, dwell) in enumerate(shown)
        ]
        self._sent = (-1, -1)

    def begin(self, session: Session) -> None:
        """Name the first state of the first walk, behind ARM; it leaves with it."""
        self._sent = (-1, -1)
        self._submit(session)

    def turn(self, session: Session, arrival_ns: int) -> None:
        """Name what follows the exposures that the core has taken, unless that has been said."""
        if self._submit(session):
            now_ns = session.link.now_ns
            session.host.poll(now_ns())
            session.flush()
            self.turns.add_many(np.array([now_ns() - arrival_ns]))

    def arrays(self, session: int) -> Drive:
        """Return what the kernel drives by in `session`."""
        return self._place.arrays(self._tails, session)

    def body(self, exposure: int, state: int) -> bytes:
        """Return the body of the SHOW that names `state` for `exposure`."""
        return exposure.to_bytes(_EXPOSURE_BYTES, "little") + self._tails[state]

    @property
    def sent(self) -> tuple[int, int]:
        """Exposure and state that were named last."""
        return self._sent

    def account(self, sent: tuple[int, int], turns_ns: npt.NDArray[np.int64]) -> None:
        """Account for what the kernel has named, and how long each answer took from the arrival of its block, int64 (n,)."""
        self._sent = sent
        self.turns.add_many(turns_ns)

    def _submit(self, session: Session) -> bool:
        core = self._core
        following = self._place.following(core.windows, core.tracker.next_exposure)
        if following == self._sent or following[0] >= core.end_exposure:
            return False
        if session.host.in_flight >= COMMAND_WINDOW:  # what waits comes late: the next walk is named in time
            return False
        exposure, state = self._sent = following
        session.host.submit(Opcode.SHOW, self.body(exposure, state), may_be_refused=True)
        return True
