"""What a device must hold for a plan, as commands: patterns, slots and, of an automaton that it follows, states.

Owns the choice of the shortest form that the device knows, and the refusal of a device that knows no automata or counts no photons; never
sends anything (connection.py does). What the device lacks is a DeviceError with the numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pans.runtime.bundle.model import Bundle
from pans.runtime.core.plan import Plan
from pans.runtime.core.plan_codec import plan_commands
from pans.runtime.errors import DeviceError
from pans.runtime.wire.commands import (
    MAX_PIXELS_PER_CHUNK,
    PatternChunk,
    announced,
    announced_channels,
    announced_counts,
    mask_chunks,
    pack_masks,
    pack_pattern,
)
from pans.runtime.wire.messages import Opcode
from pans.runtime.wire.schema import AUTOMATON_SCHEMA, COUNT_SCHEMA


def upload_commands(plan: Plan, bundle: Bundle, facts: Mapping[str, Any]) -> Iterator[tuple[Opcode, bytes]]:
    """Yield opcode and body of each command that brings `bundle`'s patterns and `plan` to a device with the WELCOME `facts`."""
    if bundle.levels == 2 and announced(facts) is not None:
        yield from ((Opcode.LOAD_MASKS, pack_masks(chunk)) for chunk in mask_chunks(bundle.pattern_levels))
    else:
        for index, levels in enumerate(bundle.pattern_levels):
            for first in range(0, len(levels), MAX_PIXELS_PER_CHUNK):
                part = levels[first : first + MAX_PIXELS_PER_CHUNK]
                yield Opcode.LOAD_PATTERN, pack_pattern(PatternChunk(index, first, len(levels), part))
    yield from plan_commands(plan)


def check_automaton(facts: Mapping[str, Any], plan: Plan) -> None:
    """Raise DeviceError when the device cannot run the plan's automaton in the way that the plan says."""
    automaton = plan.automaton
    if automaton is None:
        return
    extension = announced(facts)
    if extension is None:
        found = facts.get("automaton_schema")
        says = "no automata" if found is None else f"automata of schema {found:#010x}"
        raise DeviceError(
            f"the device announces {says}, needed {AUTOMATON_SCHEMA:#010x}: its firmware is older or newer than this runtime",
            remedy="install firmware that knows them (docs/reference/protocol.md, section 11), or run a bundle with fixed patterns",
        )
    if plan.drive == "device" and automaton.n_states > extension.states:
        raise DeviceError(
            f"the device follows automata of up to {extension.states} states, needed {automaton.n_states}",
            remedy="--drive host: the host names each state",
        )
    if extension.dwell_steps % automaton.dwell_steps:
        raise DeviceError(
            f"the device divides an exposure into {extension.dwell_steps} dwell steps, needed a multiple of {automaton.dwell_steps}",
            remedy="retrain for the device's profile",
        )
    _check_counts(facts, plan)


def _check_counts(facts: Mapping[str, Any], plan: Plan) -> None:
    """Raise DeviceError when the device cannot tell the photon numbers that the plan's automaton asks for."""
    told = announced_counts(facts)
    if plan.channels_at_once > 1:
        _check_channels(facts, plan.channels_at_once)
        return
    if plan.largest <= told:
        return
    found = facts.get("count_schema")
    if told == 1:
        says = "no photon numbers" if found is None else f"photon numbers of schema {found:#010x}"
        what = (
            f"{says}, needed {COUNT_SCHEMA:#010x}: it tells clicks, or its firmware is older or newer than this runtime"
        )
    else:
        what = f"photon numbers up to {told}, needed {plan.largest}"
    raise DeviceError(
        f"the device announces {what}",
        remedy="use a device that counts (docs/reference/protocol.md, section 13), or train with --outcomes 2",
    )


def _check_channels(facts: Mapping[str, Any], wanted: int) -> None:
    """Raise DeviceError when the device does not read `wanted` detectors at once."""
    told = announced_channels(facts)
    if told < wanted:
        raise DeviceError(
            f"the device reads {told} detector(s) at once, needed {wanted}: it has fewer, or its firmware is older or newer than this "
            "runtime",
            remedy="use a device that announces them (docs/reference/protocol.md, section 14), or train with fewer --channels",
        )
