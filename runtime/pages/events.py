"""A recorded event as a sentence; the kinds of events stand in docs/reference/formats.md."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# kind -> sentence; what stands in braces are the event's own facts
SENTENCES = {
    "late": "Decision {decision} was late: {latency_us} us after the end of its exposure.",
    "link_lost": "The device was lost: {reason}.",
    "reconnected": "The device was found again after {outage_ms} ms ({attempts} attempts).",
    "clock_step": "The device's clock jumped by {off_ns} ns at tick {tick}, more than the {allowed_ns} ns that its uncertainty allows.",
    "beyond_plan": "Exposure {exposure_index} lies beyond the plan and was left out.",
    "stream_end_unknown": "The stream ended without word of its end: from exposure {first_exposure} on some may be missing.",
    "gap": "Exposures are missing: {exposures} from number {first_exposure} on.",
    "fired": "A pulse for decision {decision} was made at tick {tick}. {refusal}",
    "gate_sent": "A pulse was asked for decision {decision} at tick {tick}.",
    "gate_refused": "The device refused the pulse for decision {decision}: {text}.",
    "gate_expired": "The pulse for decision {decision} was not made in time: {text}.",
    "actuator_lost": "The actuator was lost: {words}.",
    "calibration_warning": "About the calibration: {words}.",
    "dark_state": "Dark counts: {words}.",
    "light_changed": "The light changed: {words}.",
    "contradiction": "A message contradicts the evidence: {what}, found {found}, expected {expected}.",
    "part_deleted": "The part {name} was deleted: {why}.",
    "parts_trouble": "A part of the recording made trouble: {message}.",
    "disk_short": "The disk of the recording was nearly full: {free_bytes} bytes were free.",
    "recording_deleted": "The recording was deleted during the run: {path}. The run ended.",
    "disk_nearly_full": "The run stopped before its disk was full: {free_bytes} bytes were free, {reserve_bytes} are kept.",
    "host_clock_step": "The computer's clock was set by {step_s} s; decisions and latencies do not depend on it.",
    "note": "Noted at tick {tick}: {text}.",
    "show_refused": "The device refused to show a state: {text}.",
}


def sentence_of(event: Mapping[str, Any]) -> str:
    """Return an event as one sentence; of an unknown kind, or with facts missing, its facts in a row.

    >>> sentence_of({"kind": "reconnected", "attempts": 2, "outage_ms": 812.345})
    'The device was found again after 812 ms (2 attempts).'
    """
    kind = str(event.get("kind", "?"))
    if kind == "blame":
        return _blame(event)
    try:
        said = SENTENCES[kind].format_map({key: _plain(value) for key, value in event.items()})
        return said.replace("..", ".").strip()
    except (KeyError, IndexError, ValueError):
        facts = ", ".join(f"{key} {_plain(value)}" for key, value in event.items() if key != "kind")
        return f"{kind.replace('_', ' ')}{': ' if facts else ''}{facts}"


def _blame(event: Mapping[str, Any]) -> str:
    late = event.get("what") == "late"
    what = f"{event.get('decisions', 1)} late decisions" if late else f"{event.get('exposures', 0)} missing exposures"
    sure = "" if event.get("sure", True) else ", not surely"
    return f"The cause of {what} is {event.get('cause', 'unknown')}{sure}: {event.get('why', '')}."


def _plain(value: Any) -> str:
    if not isinstance(value, float):
        return str(value)
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
