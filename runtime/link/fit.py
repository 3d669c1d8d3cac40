"""Does a device fit the plan and the bundle, and which commands load them?

What comes in are the facts of WELCOME, a plan and a bundle; what goes out are commands (`upload_commands`) or a DeviceError with the
numbers (`check_device`). Of a simulated instrument `check_scene` compares the scene with the bundle; a real one has none.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pans.runtime.bundle.model import Bundle
from pans.runtime.core.plan import Plan
from pans.runtime.core.plan_codec import plan_commands
from pans.runtime.errors import DeviceError, UsageError
from pans.runtime.safe_text import one_line
from pans.runtime.wire.commands import (
    MAX_PIXELS_PER_CHUNK,
    PatternChunk,
    announced,
    announced_channels,
    announced_counts,
    mask_chunks,
    pack_command,
)
from pans.runtime.wire.messages import Opcode
from pans.runtime.wire.schema import AUTOMATON_SCHEMA, COUNT_SCHEMA

NAMES_SHOWN = 5
TEXT_MAX_BYTES = 240  # a receiver of WELCOME takes at most 256 bytes of text


def upload_commands(plan: Plan, bundle: Bundle, facts: Mapping[str, Any]) -> Iterator[tuple[Opcode, bytes]]:
    """Yield opcode and body of each command that brings `bundle`'s patterns and `plan` to a device with the WELCOME `facts`."""
    if bundle.levels == 2 and announced(facts) is not None:
        yield from ((Opcode.LOAD_MASKS, pack_command(chunk)) for chunk in mask_chunks(bundle.pattern_levels))
    else:
        for index, levels in enumerate(bundle.pattern_levels):
            for first in range(0, len(levels), MAX_PIXELS_PER_CHUNK):
                part = levels[first : first + MAX_PIXELS_PER_CHUNK]
                yield Opcode.LOAD_PATTERN, pack_command(PatternChunk(index, first, len(levels), part))
    yield from plan_commands(plan)


def check_device(facts: Any, plan: Plan, bundle: Bundle, tick_hz: int) -> None:
    """Raise DeviceError when what the device says of itself cannot carry out the plan."""
    limits = {
        "pattern_memory": ("pattern memory (patterns)", bundle.n_shown),
        "pattern_pixels": ("pixels of a pattern", bundle.n_pixels),
        "levels": ("projector levels", bundle.levels),
        "slot_memory": ("slot memory (slots)", plan.slots_per_cycle),
        "channels": ("detectors", bundle.n_features if plan.mode == "parallel" else 1),
    }
    for key, (what, needed) in limits.items():
        if needed > int(facts[key]):
            words = f"the device's {what}: {facts[key]}, needed {needed}"
            raise DeviceError(words, remedy="use a device or a bundle that fits")
    _check_optics(facts, bundle)
    check_automaton(facts, plan)
    if facts["mode"] != plan.mode:
        raise DeviceError(f"the device measures in {facts['mode']} mode, the profile says {plan.mode}")
    if int(facts["tick_hz"]) != tick_hz:
        raise DeviceError(
            f"the device counts {facts['tick_hz']} ticks per second, the profile says {tick_hz}",
            remedy="give the profile of this device with --profile",
        )


def _check_optics(facts: Any, bundle: Bundle) -> None:
    """A device may say which passive optics it looks through (their fingerprint); it must then be the bundle's."""
    held = facts.get("optics_sha256")
    wanted = None if bundle.analyser is None else bundle.analyser.fingerprint
    if (held is None and facts.get("simulated") is not True) or held == wanted:
        return
    has = "a projector and no passive optics" if held is None else f"passive optics {str(held)[:12]}"
    needs = "a projector" if wanted is None else f"passive optics {wanted[:12]}"
    raise DeviceError(
        f"the device has {has}, {bundle.name} needs {needs}",
        remedy="a simulated instrument gets the optics of a bundle by optics=BUNDLE.pans in its URL",
    )


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
    """Raise DeviceError when the device cannot tell the photon numbers, or read the detectors, that the plan's automaton asks for."""
    told, at_once = announced_counts(facts), announced_channels(facts)
    if plan.channels_at_once > at_once:
        older = "it has fewer, or its firmware is older or newer than this runtime"
        raise DeviceError(
            f"the device reads {at_once} detector(s) at once, needed {plan.channels_at_once}: {older}",
            remedy="use a device that announces them (docs/reference/protocol.md, section 14), or train with fewer --channels",
        )
    if plan.channels_at_once > 1 or plan.largest <= told:
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


def scene_facts(shape: tuple[int, int] | None, classes: Sequence[str]) -> dict[str, Any]:
    """Return the facts of a scene of images of `shape` (height, width; None: of any) with class names (none: unlabelled)."""
    facts: dict[str, Any] = {}
    if shape is not None:
        facts |= {"scene_height_px": shape[0], "scene_width_px": shape[1]}
    if classes:
        facts |= {
            "scene_n_classes": len(classes),
            "scene_classes": _names(classes),
            "scene_classes_sha256": _digest(classes),
        }
    return facts


def check_scene(facts: Mapping[str, Any], bundle: Bundle) -> None:
    """Raise UsageError, with the sizes and class names of both, when the scene is not one that `bundle` was made for."""
    height, width = facts.get("scene_height_px"), facts.get("scene_width_px")
    ours = bundle.image_shape
    fits = height is None or width is None or (int(height), int(width)) == tuple(ours)
    if height is not None and width is not None and ours[0] == 1:  # made of patterns without a shape
        fits = ours[1] == int(height) * int(width)
    if fits and _same_classes(facts, bundle.classes):
        return
    size = f"{height} x {width} pixels" if height is not None else "any size"
    raise UsageError(
        f"the scene {one_line(facts.get('scene', ''), 60)!r} and the bundle {one_line(bundle.name, 60)!r} do not belong together: "
        f"the scene has {size} and the classes {one_line(facts.get('scene_classes', 'unknown'), TEXT_MAX_BYTES)}; "
        f"the bundle has {ours[0]} x {ours[1]} pixels and the classes {_names(bundle.classes) or 'unknown'}",
        remedy="name a scene of the bundle's task: scene=NAME in the device URL, or --scene of `pans simulate`",
    )


def _same_classes(facts: Mapping[str, Any], classes: Sequence[str]) -> bool:
    """Whether scene and bundle mean the same classes; numbers 0, 1, 2, ... are no names, and stand for as many of any name."""
    named, count = facts.get("scene_classes_sha256"), len(classes)
    if named is None or not classes or named == _digest(classes):
        return True
    numbers = [str(number) for number in range(count)]
    return facts.get("scene_n_classes") == count and (list(classes) == numbers or named == _digest(numbers))


def scene_words(facts: Mapping[str, Any], device: str) -> str:
    """Return which scene a simulated instrument shows, "" where it does not say; `device` is the URL, which may have named it."""
    if not facts.get("scene"):
        return ""
    chosen = (
        "" if "scene=" in device or not device.startswith("sim:") else " (the default: no scene= in the device URL)"
    )
    objects = f", {facts['objects']} objects" if facts.get("objects") else ""
    return f"simulated scene {one_line(facts['scene'], 60)}{chosen}{objects}"


def _names(classes: Sequence[str]) -> str:
    """Return the first few names, cut to what WELCOME can carry."""
    more = f", ... ({len(classes)} in all)" if len(classes) > NAMES_SHOWN else ""
    text = ", ".join(one_line(name, 40) for name in classes[:NAMES_SHOWN])
    room = TEXT_MAX_BYTES - len(more)
    return text.encode()[:room].decode("utf-8", "ignore") + more


def _digest(classes: Sequence[str]) -> str:
    return hashlib.sha256("\n".join(classes).encode("utf-8", "surrogatepass")).hexdigest()
