"""A machine as plain values and tensors, for a checkpoint, and back.

Owns the two directions; never reads or writes a file.
"""

from __future__ import annotations

from typing import Any

from pans.trainer.device import here

from .light import Bits, Grey, Light
from .machine import Level, Machine


def machine_state(machine: Machine) -> dict[str, Any]:
    """Return `machine` as nested lists and dicts of tensors and numbers."""
    return {
        "counts": list(machine.counts),
        "levels": [{"successors": level.successors, **_light_state(level.light)} for level in machine.levels],
    }


def machine_from(state: dict[str, Any]) -> Machine:
    """Return the machine of `machine_state`; a brightness that all levels share is one tensor again."""
    shared: dict[str, Any] = {}
    levels = [Level(_light_from(level, shared), here(level["successors"])) for level in state["levels"]]
    return Machine(levels, [here(counts) for counts in state["counts"]])


def _light_state(light: Light) -> dict[str, Any]:
    if isinstance(light, Grey):
        return {"root": light.root, "top": light.top, "whole_levels": light.levels}
    is_shared = light.log_light.shape[0] != light.lean.shape[0]
    limits = {"bottom": light.bottom, "top": light.top}
    return {"lean": light.lean, "log_light": light.log_light, "shared": is_shared, **limits}


def _light_from(level: dict[str, Any], shared: dict[str, Any]) -> Light:
    if "root" in level:
        return Grey(here(level["root"]), level["top"], level["whole_levels"])
    log_light = here(level["log_light"])
    if level["shared"]:
        log_light = shared.setdefault("log_light", log_light)
    return Bits(here(level["lean"]), log_light, level["bottom"], level["top"])
