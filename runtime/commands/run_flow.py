"""`pans run --flow`: what a run with passing objects needs beside an ordinary one.

Owns its options, the plan, core and actuator that they ask for, and its part of the summary and of the page for people; the order of
a run is cmd_run.py's and loop.py's.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from pans.runtime.flow.settings import FlowSettings, flow_of_header, read_flow, with_gate
from pans.runtime.instrument.click_law import click_law, click_probability
from pans.runtime.instrument.profile import Profile

if TYPE_CHECKING:
    from pans.runtime.bundle.model import Bundle
    from pans.runtime.core.plan import Plan
    from pans.runtime.decide.verdict import Decider
    from pans.runtime.flow.core import FlowCore
    from pans.runtime.live.gates import Actuator
    from pans.runtime.live.run import LiveRun
    from pans.runtime.live.second_device import SecondInstrument


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a flow to `pans run`."""
    group = parser.add_argument_group("objects that pass by (docs/how-to/flow.md)")
    group.add_argument("--flow", metavar="cells|tape|FILE", help="settings of the flow: shipped ones or a TOML file")
    group.add_argument(
        "--gate-class", action="append", default=[], metavar="NAME", help="class to pulse for (repeatable, or a,b)"
    )
    group.add_argument(
        "--gate-delay-us", type=float, metavar="US", help="from leaving to the pulse (default: the settings', 900)"
    )
    group.add_argument(
        "--act",
        default="device",
        metavar="URL",
        help="what pulses: device (default: its GATE command), a second instrument's URL (tcp:HOST:PORT too), or NAME:...",
    )
    group.add_argument(
        "--act-profile",
        metavar="PROFILE",
        help="hardware profile of the second instrument (default: that of the first)",
    )
    group.add_argument(
        "--pool", type=int, metavar="N", help="windows side by side whose evidence is added (default: the settings', 1)"
    )


def settings_of(args: argparse.Namespace) -> FlowSettings | None:
    """Return the settings that the command line asks for, None without --flow."""
    if getattr(args, "flow", None) is None:
        return None
    classes = tuple(name for part in args.gate_class for name in part.split(",") if name)
    settings = with_gate(read_flow(args.flow), classes, args.gate_delay_us)
    return settings if args.pool is None else replace(settings, pool=args.pool)


def core_of(
    profile: Profile, bundle: Bundle, decider: Decider, settings: FlowSettings, shots: int, seconds: float
) -> tuple[Plan, FlowCore, int]:
    """Return plan, core and number of cycles (0: until stopped) of a flow that lasts `seconds`."""
    from pans.runtime.flow.make import make_flow_core
    from pans.runtime.flow.plan import build_flow_plan

    plan = build_flow_plan(profile, bundle, block_us=settings.block_us, dark_every=settings.dark_every)
    dark = float(click_probability(click_law(profile, plan.exposure_us), 0.0))
    cycles = math.ceil(seconds * 1e6 / plan.cycle_us * (1 - 1e-12)) if seconds else 0
    core = make_flow_core(plan, decider, settings, bundle.classes, shots=shots, dark_probability=dark, n_cycles=cycles)
    return plan, core, cycles


def replayed_core(
    header: Mapping[str, Any], plan: Plan, decider: Decider, bundle: Bundle, shots: int, n_cycles: int
) -> FlowCore:
    """Return the core of a recorded flow; `header` is `FlowRun.header`'s. KeyError, TypeError or UsageError if it is damaged."""
    from pans.runtime.flow.make import make_flow_core

    settings, dark = flow_of_header(header["settings"]), float(header["dark_probability"])
    return make_flow_core(
        plan, decider, settings, bundle.classes, shots=shots, dark_probability=dark, n_cycles=n_cycles
    )


def replayed_figures(core: FlowCore, events: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return what a replayed flow was worth; `events` tell which pulses were not made."""
    core.matcher.finish()
    for event in events:
        if event["kind"] in ("gate_refused", "gate_expired") and "decision" in event:
            core.matcher.undo(int(event["decision"]))
    return core.matcher.summary(core.frames)


class FlowRun:
    """Joins core and gates of one run, and says afterwards what came of both."""

    def __init__(self, core: FlowCore, actuator: Actuator | SecondInstrument | None) -> None:
        self.core = core
        self._actuator = actuator
        self._gates: dict[str, Any] = {}
        self._run: LiveRun | None = None

    def header(self) -> dict[str, Any]:
        """What a replay needs to make the same core."""
        return {"settings": self.core.settings.as_header(), "dark_probability": self.core.dark_probability}

    def prepared(self, run: LiveRun) -> None:
        """Before arming: pulses go to the actuator, and the figures hear of those that were not made."""
        self._run = run
        from pans.runtime.live.second_device import SecondInstrument

        if isinstance(self._actuator, SecondInstrument):
            self._actuator.connect()
            run.gates.second = self._actuator
        else:
            run.gates.actuator = self._actuator
        run.gates.failed = self.core.matcher.undo

    def summary(self) -> dict[str, Any]:
        """Return the flow's part of the summary, under the contract's keys."""
        from pans.runtime.live.second_device import SecondInstrument

        core = self.core
        core.matcher.finish()
        second = self._actuator.facts() if isinstance(self._actuator, SecondInstrument) else None
        if self._actuator is not None:
            self._actuator.close()
        limits = core.limits
        return {
            "flow": {
                "kind": core.settings.kind,
                "frames_per_decision": core.frames,
                "pool": core.settings.pool,
                "bars_per_s": getattr(core, "bars_per_s", None),  # of a tape: as said, or as last found
                "onset_clicks": limits.onset_clicks,
                "release_clicks": limits.release_clicks,
                "onset_frames": limits.onset_frames,
                "longest_frames": limits.longest,
                "empty_frames": core.empty_frames,
                "gate_delay_us": core.settings.gate_delay_us,
                "gate_classes": list(core.settings.gate_classes),
            },
            **core.matcher.summary(core.frames),
            "gates": {} if self._run is None else self._run.gates.summary(),
            "second_instrument": second,
        }


def flow_faults(summary: Mapping[str, Any]) -> list[str]:
    """Return one sentence for each broken promise of the gates."""
    gates = summary["gates"]
    lost = gates.get("refused", 0) + gates.get("expired", 0)
    return (
        [f"{lost} of {gates['asked']} pulses were not made: {gates['refused']} refused, {gates['expired']} expired"]
        if lost
        else []
    )


def flow_rows(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return name and text of the figures that only a flow has."""
    counts, gates = summary["passages"], summary["gates"]
    aborted = ", ".join(f"{name} {n}" for name, n in summary["aborted"].items()) or "none"
    rows = [
        (
            "passages (alone, in coincidence, in gaps)",
            f"{counts['alone']}, {counts['coincident']}, {counts['in_gaps']}",
        ),
        ("accuracy per passage alone, 95 % interval", _share(summary, "accuracy")),
        ("accuracy where a label was given", _share(summary, "accuracy_labelled")),
        ("missed, of those alone", _share(summary, "missed")),
        ("doubled, of those alone", _share(summary, "doubled")),
        ("decisions without a passage", str(counts["without_mark"])),
        ("coincidences aborted / labelled", f"{counts['coincident_aborted']} / {counts['coincident_labelled']}"),
        ("aborted", aborted),
        ("yield (targets pulsed)", _share(summary, "yield")),
        ("purity (pulses on a target alone)", _share(summary, "purity")),
        ("pulses asked, done, refused, expired", ", ".join(str(n) for n in gates.values())),
        ("clicks of the whole passage", _mean(summary["passage_clicks_mean"])),
        ("photons of the whole passage, at least (scaled by clicks)", _mean(summary["passage_photons_mean"])),
    ]
    return rows


def flow_words(summary: Mapping[str, Any]) -> list[str]:
    """Return the lines of a flow's closing words."""
    gates = summary["gates"]
    pulses = f"asked {gates['asked']}, done {gates['done']}, refused {gates['refused']}, expired {gates['expired']}"
    return [*passage_words(summary), f"  gates         {pulses}"]


def passage_words(summary: Mapping[str, Any]) -> list[str]:
    """Return what the decisions about passing objects were worth, in lines; all of it is known in a replay, too."""
    counts = summary["passages"]
    return [
        f"  passages      {counts['marks']}: {counts['alone']} alone, {counts['coincident']} in coincidence, {counts['in_gaps']} in gaps; "
        f"missed {_share(summary, 'missed')}, doubled {_share(summary, 'doubled')}",
        f"  accuracy      {_share(summary, 'accuracy')} of those alone",
        f"  aborted       {', '.join(f'{name} {n}' for name, n in summary['aborted'].items()) or 'none'}",
        f"  light         {_mean(summary['clicks_mean'])} clicks of the window, {_mean(summary['passage_clicks_mean'])} of the passage",
        f"  pulses        {counts['pulses']} made; yield {_share(summary, 'yield')}, purity {_share(summary, 'purity')}",
    ]


def _share(summary: Mapping[str, Any], name: str) -> str:
    value, interval = summary[name], summary[f"{name}_ci"]
    return "unknown" if value is None else f"{value:.3%} ({interval[0]:.3%} to {interval[1]:.3%})"


def _mean(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3f}"
