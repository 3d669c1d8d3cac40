"""A machine as plain values and tensors, for a checkpoint, and back.

Owns the two directions; never reads or writes a file.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

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
    """Return the machine of `machine_state`; a tensor that several levels shared is one tensor again."""
    shared: dict[int, Tensor] = {}
    levels = [Level(_light_from(level, shared), here(level["successors"])) for level in state["levels"]]
    return Machine(levels, [here(counts) for counts in state["counts"]])


def _light_state(light: Light) -> dict[str, Any]:
    if isinstance(light, Grey):
        return {"root": light.root, "top": light.top, "whole_levels": light.levels}
    limits = {"bottom": light.bottom, "top": light.top}
    return {"lean": light.lean, "log_light": light.log_light, "rows": light.rows, **limits}


def _light_from(level: dict[str, Any], shared: dict[int, Tensor]) -> Light:
    def once(tensor: Tensor) -> Tensor:
        return shared.setdefault(tensor.data_ptr(), here(tensor))  # torch.load keeps what was one storage one

    if "root" in level:
        return Grey(here(level["root"]), level["top"], level["whole_levels"])
    rows = None if level["rows"] is None else here(level["rows"])
    return Bits(once(level["lean"]), once(level["log_light"]), level["bottom"], level["top"], rows)
