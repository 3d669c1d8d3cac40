"""A run with passing objects: the actuator, and the flow's part of the summary."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pans.decide.flow import FlowCore, PassageFigures

from .gates import Actuator, GateQueue, SecondInstrument
from .status import Status


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
        self._gates: GateQueue | None = None

    def header(self) -> dict[str, Any]:
        """What a replay needs to make the same core."""
        return {"settings": self.core.settings.as_header(), "dark_probability": self.core.dark_probability}

    def prepared(self, run: Status) -> None:
        """Before arming: pulses go to the actuator, and the figures hear of those that were not made."""
        gates = self._gates = run.accounts.gates
        if isinstance(self._actuator, SecondInstrument):
            self._actuator.connect()
            gates.second = self._actuator
        else:
            gates.actuator = self._actuator
        gates.failed = self.core.matcher.undo

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
            "bars_per_s": core.bars_per_s,  # of a tape: as said, or as last found
            "onset_clicks": limits.onset_clicks,
            "release_clicks": limits.release_clicks,
            "onset_frames": limits.onset_frames,
            "longest_frames": limits.longest,
            "empty_frames": core.empty_frames,
            "gate_delay_us": settings.gate_delay_us,
            "gate_classes": list(settings.gate_classes),
        }
        gates = {} if self._gates is None else self._gates.summary()
        return FlowFigures(flow, core.matcher.figures(core.frames), gates, second)
