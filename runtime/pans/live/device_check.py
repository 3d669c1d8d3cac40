"""Does a device fit the plan and the bundle, and which commands load them?

What comes in are the facts of WELCOME, a plan and a bundle; what goes out are commands (`upload_commands`) or a DeviceError with the
numbers (`check_device`). Of a simulated instrument `check_scene` compares the scene with the bundle; a real one has none.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pans.base.console import one_line
from pans.base.errors import DeviceError, UsageError
from pans.bundle.automaton import Automaton
from pans.bundle.sensor import Bundle
from pans.decide.plan import Plan, plan_commands
from pans.protocol.wire import (
    AUTOMATON_SCHEMA,
    COUNT_SCHEMA,
    MAX_PIXELS_PER_CHUNK,
    Opcode,
    PatternChunk,
    announced,
    announced_channels,
    announced_counts,
    mask_chunks,
    pack_command,
)

NAMES_SHOWN = 5
OTHER_RELEASE = "its firmware is older or newer than this runtime"
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


def check_device(facts: Mapping[str, Any], plan: Plan, bundle: Bundle, tick_hz: int) -> None:
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
        words = f"the device counts {facts['tick_hz']} ticks per second, the profile says {tick_hz}"
        raise DeviceError(words, remedy="give the profile of this device with --profile")


def _check_optics(facts: Mapping[str, Any], bundle: Bundle) -> None:
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
    if plan.automaton is not None:
        for words, remedy in _automaton_faults(facts, plan, plan.automaton):
            raise DeviceError(words, remedy=remedy)


def _automaton_faults(facts: Mapping[str, Any], plan: Plan, automaton: Automaton) -> Iterator[tuple[str, str]]:
    """What the device cannot do of the automaton, and what to do about it."""
    extension, largest, at_once = announced(facts), announced_counts(facts), announced_channels(facts)
    if extension is None:
        words = f"the device announces {_announced_as(facts, 'automaton_schema', 'automata')}, needed {AUTOMATON_SCHEMA:#010x}"
        remedy = "install firmware that knows them (docs/reference/protocol.md, section 11), or run a bundle with fixed patterns"
        yield f"{words}: {OTHER_RELEASE}", remedy
        return
    if plan.drive == "device" and automaton.n_states > extension.states:
        words = f"the device follows automata of up to {extension.states} states, needed {automaton.n_states}"
        yield words, "--drive host: the host names each state"
    if extension.dwell_steps % automaton.dwell_steps:
        steps = f"{extension.dwell_steps} dwell steps, needed a multiple of {automaton.dwell_steps}"
        yield f"the device divides an exposure into {steps}", "retrain for the device's profile"
    if plan.channels_at_once > at_once:
        words = f"the device reads {at_once} detector(s) at once, needed {plan.channels_at_once}"
        remedy = (
            "use a device that announces them (docs/reference/protocol.md, section 14), or train with fewer --channels"
        )
        yield f"{words}: it has fewer, or {OTHER_RELEASE}", remedy
    if plan.channels_at_once == 1 and plan.largest > largest:
        what = f"photon numbers up to {largest}, needed {plan.largest}"
        if largest == 1:
            says = _announced_as(facts, "count_schema", "photon numbers")
            what = f"{says}, needed {COUNT_SCHEMA:#010x}: it reads clicks, or {OTHER_RELEASE}"
        remedy = "use a device that counts (docs/reference/protocol.md, section 13), or train with --outcomes 2"
        yield f"the device announces {what}", remedy


def _announced_as(facts: Mapping[str, Any], key: str, what: str) -> str:
    return f"{what} of schema {facts[key]:#010x}" if key in facts else f"no {what}"


def scene_facts(shape: tuple[int, int] | None, classes: Sequence[str]) -> dict[str, Any]:
    """Return the facts of a scene of images of `shape` (height, width; None: of any) with class names (none: unlabelled)."""
    facts: dict[str, Any] = {} if shape is None else {"scene_height_px": shape[0], "scene_width_px": shape[1]}
    if classes:
        names = {"scene_classes": _names(classes), "scene_classes_sha256": _digest(classes)}
        facts |= {"scene_n_classes": len(classes), **names}
    return facts


def check_scene(facts: Mapping[str, Any], bundle: Bundle) -> None:
    """Raise UsageError, with the sizes and class names of both, when the scene is not one that `bundle` was made for."""
    height, width = facts.get("scene_height_px"), facts.get("scene_width_px")
    ours, size = bundle.image_shape, "any size"
    fits = height is None or width is None
    if height is not None and width is not None:  # patterns without a shape are one row of pixels
        size = f"{height} x {width} pixels"
        fits = ours in ((int(height), int(width)), (1, int(height) * int(width)))
    if fits and _same_classes(facts, bundle.classes):
        return
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
    by_default = "scene=" not in device and device.startswith("sim:")
    chosen = " (the default: no scene= in the device URL)" if by_default else ""
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
