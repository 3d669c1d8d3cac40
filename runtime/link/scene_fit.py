"""Do the scene of a simulated instrument and a bundle belong together?

Owns the facts by which a simulated instrument describes its scene in WELCOME, and their comparison with the bundle; a real instrument has
none of them. `scene_facts` makes them, `check_scene` raises UsageError, `scene_words` names the scene for people.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

from pans.runtime.bundle.model import Bundle
from pans.runtime.errors import UsageError
from pans.runtime.safe_text import one_line

NAMES_SHOWN = 5
TEXT_MAX_BYTES = 240  # a receiver of WELCOME takes at most 256 bytes of text


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
