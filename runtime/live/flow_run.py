"""A run with passing objects: core and gates joined, and what came of both.

Owns the actuator while the run lasts and the flow's part of the summary; the order of a run is loop.py's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pans.runtime.flow.core import FlowCore
from pans.runtime.flow.matching import PassageFigures

from .gates import Actuator
from .second_device import SecondInstrument

if TYPE_CHECKING:
    from .run import LiveRun


@dataclass(frozen=True, slots=True)
class FlowFigures:
    """What came of a run with passing objects: its settings, what the decisions were worth, what became of the pulses."""

    flow: dict[str, Any]
    passages: PassageFigures
    gates: dict[str, int]
    second_instrument: dict[str, Any] | None

    def as_json(self) -> dict[str, Any]:
        """Return the figures under the contract's keys."""
        rest = {"gates": self.gates, "second_instrument": self.second_instrument}
        return {"flow": self.flow, **self.passages.as_json(), **rest}


class FlowRun:
    """Joins core and gates of one run, and says afterwards what came of both."""

    def __init__(self, core: FlowCore, actuator: Actuator | SecondInstrument | None) -> None:
        self.core = core
        self._actuator = actuator
        self._run: LiveRun | None = None

    def header(self) -> dict[str, Any]:
        """What a replay needs to make the same core."""
        return {"settings": self.core.settings.as_header(), "dark_probability": self.core.dark_probability}

    def prepared(self, run: LiveRun) -> None:
        """Before arming: pulses go to the actuator, and the figures hear of those that were not made."""
        self._run = run
        if isinstance(self._actuator, SecondInstrument):
            self._actuator.connect()
            run.gates.second = self._actuator
        else:
            run.gates.actuator = self._actuator
        run.gates.failed = self.core.matcher.undo

    def figures(self) -> FlowFigures:
        """Let go of the actuator and return the flow's part of the summary."""
        core, limits, settings = self.core, self.core.limits, self.core.settings
        core.matcher.finish()
        second = self._actuator.facts() if isinstance(self._actuator, SecondInstrument) else None
        if self._actuator is not None:
            self._actuator.close()
        flow = {
            "kind": settings.kind,
            "frames_per_decision": core.frames,
            "pool": settings.pool,
            "bars_per_s": getattr(core, "bars_per_s", None),  # of a tape: as said, or as last found
            "onset_clicks": limits.onset_clicks,
            "release_clicks": limits.release_clicks,
            "onset_frames": limits.onset_frames,
            "longest_frames": limits.longest,
            "empty_frames": core.empty_frames,
            "gate_delay_us": settings.gate_delay_us,
            "gate_classes": list(settings.gate_classes),
        }
        gates = {} if self._run is None else self._run.gates.summary()
        return FlowFigures(flow, core.matcher.figures(core.frames), gates, second)
