"""The summary of a run: its figures, its faults and the verdict, as facts and as the JSON of the contract."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from pans.base.machine import load_average
from pans.base.numbers import Part, keys_of
from pans.bundle.sensor import Bundle
from pans.decide.dark import DarkReport
from pans.decide.plan import Plan
from pans.live.loop import DarkFigures, RunResult, TallyFigures
from pans.live.stop import ASKED_TO_STOP, DISK_NEARLY_FULL, INTERRUPTED

if TYPE_CHECKING:
    from pans.live.loop import FlowFigures

MAX_VERDICTS = 20  # of a summary; the recording has them all
FIRST_NAMED = 3  # late decisions
BUSY = 0.05  # of the time: who waits longer for a processor shares it with other programs
LATE_WHEN_BUSY = 0.05  # of the decisions: beyond that a computer cannot show what the demo is for
_ONE = r"(?<![\d.,])1 (attempt|click|decision|exposure|gap|message|object|part|pulse|slot|time)s\b"


@dataclass(frozen=True, slots=True)
class WalkFigures:
    """Figures of a run with an automaton; None where it is not known."""

    drive: str  # device or host
    confidence: float  # at which a walk was to end; 0.0: none
    exposures_mean: float | None  # of a walk, dark ones left out
    illumination_mean: float | None  # per decision, photoelectrons per unit transmission, of the states that were shown
    abstained_below_confidence: int
    late_slots: int  # that stayed dark because the host named no state in time
    # From a block's arrival until the next state's name had left; None unless the host drives.
    turn_us: dict[str, float | None] | None
    turn_budget_us: float | None  # from the end of an exposure to the beginning of the next one
    expected: dict[str, Any] | None  # as the bundle says it: for its profile, task and split
    # measured accuracy less the expected one, in standard errors, on the same profile
    expected_off_stderr: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary(TallyFigures):
    """Results of a run. The fields have the names of the table of figures; as_json() adds those of `flow` and `walks`."""

    flow: FlowFigures | None  # of passing objects: its figures of the same name replace those of still ones
    walks: WalkFigures | None  # of an automaton
    illumination: float  # per decision, photoelectrons per unit transmission
    late: int
    late_blame: dict[str, int]
    late_cause: dict[str, int]
    lost_cause: dict[str, int]
    blame: list[dict[str, Any]]
    lost: int
    latency_us: dict[str, float | None]
    stage_latency_us: dict[str, dict[str, float | None]]
    deadline_us: float
    clock: dict[str, Any]
    slot_jitter_us: float
    exposure_timing: dict[str, Any]  # of what the device told (decide.exposure_timing)
    wrong_patterns: int
    dark: DarkReport
    stream: dict[str, int]
    link: dict[str, int]
    contradictions: dict[str, int]  # what the evidence excludes, by what is wrong; malformed messages too
    realtime: dict[str, Any]
    page_faults: dict[str, int]  # of the loop's thread while armed, and how often its core was taken away
    device: dict[str, Any]
    armed_after_s: float
    seconds: float
    ended: str
    link_lost: bool
    reconnects: int
    decisions_sha256: str
    simulated: bool
    verdict: str
    faults: list[str]
    warnings: list[str]  # what may have spoilt decisions, and is no fault
    calibration: dict[str, Any] | None
    calibration_warnings: list[str]
    light: dict[str, Any] | None
    registration: dict[str, Any] | None = None  # of the optical table, and what the correction of the patterns came to
    late_allowed: float = 0.0  # share of the decisions
    busy: str = ""  # why few late decisions are no fault of this run, whose verdict is PASS in spite of them

    @property
    def too_late(self) -> bool:
        """Whether more decisions were late than the run allowed; not where a busy computer is the reason."""
        return not self.busy and self.late > self.late_allowed * self.decisions

    def as_json(self) -> dict[str, Any]:
        """Return the summary under the contract's keys, in their order."""
        facts = {key: getattr(self, key) for key in keys_of(Part.DECISIONS)}
        facts |= {} if self.flow is None else self.flow.as_json()
        facts |= {} if self.walks is None else asdict(self.walks)
        facts |= {key: getattr(self, key) for key in keys_of(Part.RUN)}
        return facts | {"dark": asdict(self.dark)}


def summarise(
    result: RunResult,
    *,
    illumination: float,
    expected_decisions: int,
    flow: FlowFigures | None = None,
    dark: DarkFigures | None = None,
    walks: WalkFigures | None = None,
    registration: dict[str, Any] | None = None,
    late_allowed: float = 0.0,
    may_be_busy: bool = False,
) -> Summary:
    """Return the summary of `result`; `illumination` is per decision, in photoelectrons per unit transmission.

    With `may_be_busy`, as of a demo, up to LATE_WHEN_BUSY of the decisions may be late where the evidence says that other programs kept
    the host waiting, and nothing else is wrong.
    """
    timing = result.timing
    dark = DarkFigures(None, [], None, [], []) if dark is None else dark
    more = ([] if flow is None else gate_faults(flow.gates)) + dark.faults
    faults = find_faults(result, expected_decisions, aborts_are_faults=flow is None, late_allowed=late_allowed) + more
    busy = ""
    if may_be_busy and faults and is_busy(result):
        forgiven = find_faults(result, expected_decisions, aborts_are_faults=flow is None, late_allowed=LATE_WHEN_BUSY)
        if not forgiven + more:
            load = f"load {load_average():.1f} on {os.cpu_count()} cores"
            busy, faults = f"{timing.late} of {result.tally.decisions} late: this computer is busy ({load})", []
    made: dict[str, Any] = {
        "illumination": illumination,
        "late": timing.late,
        "late_blame": timing.blame,
        "blame": [event for event in result.events if event["kind"] == "blame"][:MAX_VERDICTS],
        "lost": result.stream["lost_exposures"],
        "latency_us": timing.total.summary(),
        "stage_latency_us": {name: histogram.summary() for name, histogram in timing.stages.items()},
        "deadline_us": timing.deadline_ns / 1000,
        "clock": result.clock | {"worst_uncertainty_us": timing.worst_uncertainty_ns / 1000},
        "link": result.decoder,
        "contradictions": contradictions_of(result),
        "device": {str(key): one for key, one in result.device.items() if isinstance(one, (str, int, float, bool))},
        "simulated": bool(result.device.get("simulated")),
        "verdict": "FAIL" if faults else "PASS",
        "faults": faults,
        "warnings": dark.changes,
        "calibration": dark.calibration,
        "calibration_warnings": dark.warnings,
        "light": dark.light,
        "registration": registration,
        "late_allowed": late_allowed,
        "busy": busy,
    }
    same = {name: getattr(result, name) for name in keys_of(Part.RUN) if name not in made}
    decisions = asdict(result.tally.figures())
    passing = {} if flow is None else flow.as_json()
    decisions |= {name: passing[name] for name in decisions if name in passing}
    if walks is not None:  # which of the states shown belonged to which decision is not counted
        of_states = ("illumination", "illumination_mean", "exposures_mean")
        decisions["figures_of"] |= dict.fromkeys(of_states, "decisions")
    return Summary(flow=flow, walks=walks, **decisions, **made, **same)


def is_busy(result: RunResult) -> bool:
    """Whether other programs that shared the computer made most late decisions late."""
    simulated, waited_ms = bool(result.device.get("simulated")), result.page_faults.get("waited_ms", 0)
    return was_busy(simulated, result.timing.late, result.late_cause, waited_ms, result.seconds)


def was_busy(simulated: bool, late: int, late_cause: Mapping[str, int], waited_ms: float, seconds: float) -> bool:
    """As `is_busy`: half of the late decisions by the host, or its loop waited for a processor for BUSY of the time.

    A simulated instrument shares the computer: what is late there looks like its link's or its own delay.
    """
    waits = simulated and waited_ms >= BUSY * 1000 * seconds
    return bool(late) and (waits or 2 * late_cause.get("host", 0) >= late)


def find_faults(
    result: RunResult, expected_decisions: int, aborts_are_faults: bool = True, late_allowed: float = 0.0
) -> list[str]:
    """Return one sentence for each way in which the run broke its promise; empty means PASS. `late_allowed`: share of late decisions."""
    tally, timing, stream = result.tally, result.timing, result.stream
    faults = []
    if result.link_lost and result.ended in (ASKED_TO_STOP, INTERRUPTED):
        faults.append(f"the device was lost and had not been found again when the run was {result.ended}")
    elif result.link_lost or result.ended == DISK_NEARLY_FULL:
        faults.append(result.ended)
    if result.reconnects:
        faults.append(f"the device was lost and found again {result.reconnects} times")
    if timing.late > late_allowed * tally.decisions:
        half_us, limit_ms = timing.total.summary()["p50"] or 0.0, timing.deadline_ns / 1e6
        short = f"; half of all decisions took more than {half_us:,.0f} us" if half_us > 1000 * limit_ms else ""
        of, allowed = (f" of {tally.decisions:,}", f", allowed {late_allowed * 100:g} %") if late_allowed else ("", "")
        faults.append(f"{timing.late}{of} decisions later than {limit_ms:g} ms{allowed} ({late_words(result)}){short}")
    if stream["lost_exposures"]:
        dropped = f"{stream['device_drops']} of them dropped by the device"
        faults.append(f"{stream['lost_exposures']} exposures lost in {stream['gaps']} gaps, {dropped}")
    if stream["lost_messages"] and not stream["lost_exposures"]:
        faults.append(f"{stream['lost_messages']} messages lost, which held no exposures: marks of objects")
    if contradictions := contradictions_of(result):
        kinds = ", ".join(f"{what} {count}" for what, count in sorted(contradictions.items()))
        faults.append(f"{sum(contradictions.values())} messages contradict the evidence: {kinds}")
    wrong = result.wrong_patterns - (result.late_slots if result.turn_us else 0)
    if wrong:
        faults.append(f"{wrong} exposures showed another pattern than planned")
    if wrong != result.wrong_patterns:
        longest = f"the longest turn took {result.turn_us['max'] or 0.0:.0f} us"
        faults.append(f"{result.late_slots} slots stayed dark because the host named their state too late; {longest}")
    if tally.abstained > tally.unsure and aborts_are_faults:
        faults.append(f"{tally.abstained - tally.unsure} decisions abstained")
    if expected_decisions and tally.decisions != expected_decisions:
        faults.append(f"{tally.decisions} of {expected_decisions} decisions were made; the run ended: {result.ended}")
    if fault := exposure_fault(result.exposure_timing, stream["exposures"]):
        faults.append(fault)
    if result.dark.alarm:
        faults.append(result.dark.alarm)
    faults += [event["words"] for event in result.dark.findings if event["level"] == "alarm"]
    return [singular(fault) for fault in faults]


def singular(text: str) -> str:
    """Return a text of ours with the nouns behind a 1 in the singular.

    >>> singular("1 exposures lost in 1 gaps, 21 times"), singular("1 late from decision 66 on")
    ('1 exposure lost in 1 gap, 21 times', '1 late: decision 66')
    """
    text = re.sub(r"(?<![\d.,])1 (late|missing) from (decision|exposure) (\d+) on", r"1 \1: \2 \3", text)
    text = re.sub(_ONE, r"1 \1", text)
    return text.replace("1 message contradict ", "1 message contradicts ")


def late_words(result: RunResult) -> str:
    """Return the causes of late decisions, the most frequent first, how far the evidence shows them, and the first late decisions."""
    found = [event for event in result.events if event["kind"] == "blame" and event["what"] == "late"]
    sure = {cause: [bool(event["sure"]) for event in found if event["cause"] == cause] for cause in result.late_cause}
    doubts = {c: ", not certain" if not any(one) else ", not always certain" for c, one in sure.items() if not all(one)}
    causes = (f"{cause} {n}{doubts.get(cause, '')}" for cause, n in Counter(result.late_cause).most_common())
    first = ", ".join(str(event["first_decision"]) for event in found[:FIRST_NAMED])
    return f"cause: {'; '.join(causes)}{f'; first at decision {first}' if found else ''}"


def exposure_fault(timing: Mapping[str, Any], received: int = 0) -> str:
    """Return what is wrong with when the `received` exposures happened, as the device told; "" if nothing is, or it need not tell."""
    if timing.get("announced") and received and not timing["exposures"]:
        told = f"the device announces EXPOSED, and told of none of {received} exposures"
        return f"{told}: pans conform --rule 15.1 tries it"
    if timing.get("within") is not False:
        if not timing.get("untold"):
            return ""
        told = f"EXPOSED reported {timing['exposures']} exposures, but {timing['untold']} more had ended"
        return f"{told}: pans conform --rule 15.1 tries it"
    allowed_us = timing["tolerance_us"]
    worst = ((what, timing[f"worst_{what}_exposure"], timing[f"worst_{what}_us"]) for what in ("start", "length"))
    farther = (f"the {what} of exposure {n} was {us:+.3g} us off" for what, n, us in worst if abs(us) > allowed_us)
    allowed = f"allowed {allowed_us:.3g} us (timing.exposure_tolerance_us)"
    return f"{' and '.join(farther)}, {allowed}: pans conform --rule 15.2 tries the device"


def contradictions_of(result: RunResult) -> dict[str, int]:
    """Return how many messages cannot have been meant or cannot be true, by what is wrong in them; empty when all is well."""
    malformed = result.stream["malformed"] + result.decoder.get("malformed_answers", 0)
    found = {"malformed": malformed, "implausible_answers": result.decoder.get("implausible_answers", 0)}
    return {what: count for what, count in (found | result.contradictions).items() if count}


def gate_faults(gates: Mapping[str, int]) -> list[str]:
    """Return one sentence if pulses were not made."""
    lost = gates.get("refused", 0) + gates.get("expired", 0)
    counts = f"{gates.get('refused', 0)} refused, {gates.get('expired', 0)} expired"
    return [f"{lost} of {gates['asked']} pulses were not made: {counts}"] if lost else []


def walk_figures(result: RunResult, plan: Plan, bundle: Bundle, profile: str, confidence: float) -> WalkFigures | None:
    """Return the figures of a run of `plan` on `profile`; None where the patterns are fixed."""
    if plan.automaton is None:
        return None
    tally, expected = result.tally, bundle.expected
    hosted = plan.drive == "host"
    light = float(result.states_shown @ bundle.light_of(plan.automaton))
    figures, off, stated = tally.figures(), None, bundle.expected_on(profile, plan.automaton)
    if stated is not None and figures.accuracy is not None and figures.accuracy_stderr_objects:
        off = (figures.accuracy - float(stated["accuracy"])) / figures.accuracy_stderr_objects
    return WalkFigures(
        drive=plan.drive,
        confidence=confidence,
        exposures_mean=tally.exposures / tally.decisions if tally.decisions else None,
        illumination_mean=light / tally.decisions if tally.decisions else None,
        abstained_below_confidence=tally.unsure,
        late_slots=result.late_slots,
        turn_us=result.turn_us if hosted else None,
        turn_budget_us=(plan.slot_period_ticks - plan.exposure_ticks) * plan.tick_us if hosted else None,
        expected=None if expected is None else dict(expected),
        expected_off_stderr=off,
    )
