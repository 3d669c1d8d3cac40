"""A machine as plain values and tensors, for a checkpoint, and back; and a machine made of an automaton in a bundle.

Owns these directions; never reads or writes a file.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pans.runtime.bundle.model import Bundle
from pans.runtime.errors import UsageError
from pans.trainer.device import here

from .light import BRIGHTNESS_MIN, Bits, Grey, Light
from .machine import Level, Machine

LEAN = 0.3  # of a pixel that is lit or not, where a bundle says no more: a hundred steps at the usual rate turn it


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
    return {"lean": light.lean, "log_light": light.log_light, "rows": light.rows, "parts": light.parts, **limits}


def _light_from(level: dict[str, Any], shared: dict[int, Tensor]) -> Light:
    def once(tensor: Tensor) -> Tensor:
        return shared.setdefault(tensor.data_ptr(), here(tensor))  # torch.load keeps what was one storage one

    if "root" in level:
        return Grey(here(level["root"]), level["top"], level["whole_levels"])
    rows = None if level["rows"] is None else here(level["rows"])
    lean, log_light = once(level["lean"]), once(level["log_light"])
    return Bits(lean, log_light, level["bottom"], level["top"], rows, level.get("parts", 1))


def machine_of(bundle: Bundle) -> Machine:
    """Return the machine of an automaton's bundle, one bit and a brightness per state; a leaf counts one object, by its posterior.

    UsageError for a bundle without an automaton or with grey patterns.
    """
    automaton = bundle.automaton
    if automaton is None:
        raise UsageError(f"{bundle.name} holds no automaton", remedy="start from one of --encoder automaton")
    levels, counts = [], []
    for number in range(automaton.n_slots):
        own, after = (np.flatnonzero(automaton.depth == depth) for depth in (number, number + 1))
        edges = automaton.successors[own].astype(np.int64)
        leaves = np.unique(edges[edges >= automaton.n_states])
        nodes = np.concatenate([after, leaves])  # rising, as leaves are numbered after all states
        successors = np.ascontiguousarray(np.searchsorted(nodes, edges).T)
        levels.append(Level(_bits_of(bundle, own), here(torch.from_numpy(successors))))
        counts.append(here(torch.from_numpy(automaton.posteriors[leaves])))
    return Machine(levels, counts)


def _bits_of(bundle: Bundle, states: NDArray[np.int64]) -> Bits:
    assert bundle.automaton is not None
    parts, n_pixels = bundle.automaton.channels, bundle.n_pixels
    shown = bundle.pattern_levels[bundle.automaton.rows[states]].astype(np.int64).reshape(len(states), -1)
    lit, most = shown > 0, shown.max(axis=1, keepdims=True)
    if (lit & (shown != most)).any():
        raise UsageError(
            f"{bundle.name} has grey patterns, a training starts from patterns of one bit and a brightness",
            remedy="start from an automaton trained without --grey",
        )
    part = bundle.automaton.dwell[states, None] / bundle.automaton.dwell_steps
    brightness = np.maximum(BRIGHTNESS_MIN, most * bundle.photons_per_level * part)
    lean = torch.from_numpy(np.where(lit, LEAN, -LEAN).astype(np.float32).reshape(-1, n_pixels))
    return Bits(here(lean), here(torch.from_numpy(np.log(brightness).astype(np.float32))), parts=parts)
