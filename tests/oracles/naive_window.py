"""Slow oracles for the window kernels, in plain loops over Python numbers: the meaning, not the speed."""

from typing import Any

from pans.decide.plan.plan import Plan
from pans.protocol.wire import ADAPTIVE_PATTERN, DARK_PATTERN


def count_visits(
    plan: Plan, n_features: int, shots: int, exposures: dict[int, tuple[int, int]]
) -> dict[tuple[int, int], Any]:
    """Return {(visit, window): (counts, missing, wrong)} from {exposure: (shown pattern, bit)} of a sequential run."""
    per_cycle = plan.slots_per_cycle
    per_visit = per_cycle * plan.cycles_per_object
    found: dict[tuple[int, int], Any] = {}
    for exposure, (shown, bit) in exposures.items():
        visit, relative = divmod(exposure, per_visit)
        cycle, slot = divmod(relative, per_cycle)
        planned = int(plan.slot_pattern[slot])
        if planned == DARK_PATTERN:
            continue
        window = (cycle * plan.shots_per_cycle + int(plan.slot_shot[slot])) // shots
        counts, right, wrong = found.setdefault((visit, window), ([0] * n_features, 0, 0))
        if shown == planned:
            counts[planned] += bit
            found[visit, window] = (counts, right + 1, wrong)
        else:
            found[visit, window] = (counts, right, wrong + 1)
    return {key: (counts, shots * n_features - right - wrong, wrong) for key, (counts, right, wrong) in found.items()}


def follow_walk(plan: Plan, cycle: int, exposures: dict[int, tuple[int, int]]) -> dict[str, Any]:
    """Return what became of the walk in one cycle of an automaton's plan, from {exposure: (stamped state, bit)} of the run.

    `fate` is "whole", "lost" (an exposure of the walk never came) or "wrong" (one was stamped otherwise); `clicks` are those before that,
    `states` the states that were shown, `last` the exposure at which the fate of a whole walk was settled, `dark` the clicks of what stood
    in the dark, and `strange` how many exposures that should have been dark, or another state, were not; `late` of them stayed dark.
    """
    automaton = plan.automaton
    clicks = [0] * int((plan.slot_pattern == ADAPTIVE_PATTERN).sum())
    found: dict[str, Any] = {"fate": "", "clicks": clicks, "states": [], "last": 0, "dark": [], "strange": 0, "late": 0}
    node, step = 0, 0
    for slot, planned in enumerate(plan.slot_pattern.tolist()):
        exposure = cycle * plan.slots_per_cycle + slot
        here = exposures.get(exposure)
        walking = planned == ADAPTIVE_PATTERN and not found["fate"]
        if walking:
            step += 1
        if here is None:
            found["fate"] = found["fate"] or ("lost" if walking else "")
            continue
        stamp, bit = here
        if walking and stamp == node:
            clicks[step - 1] = bit
            found["states"].append(node)
            node = int(automaton.successors[node][bit])
            if node >= automaton.n_states:
                found["fate"], found["last"], found["leaf"] = "whole", exposure, node - automaton.n_states
        elif walking:
            found["fate"] = "wrong"
            found["strange"] += 1
            found["late"] += stamp == DARK_PATTERN
        elif stamp == DARK_PATTERN:
            found["dark"].append(bit)
        elif planned == DARK_PATTERN or found["fate"] == "whole":
            found["strange"] += 1
    return found


def earliest_decision(plan: Plan, shots: int, exposures: list[tuple[int, int]]) -> int:
    """Return the earliest exposure that can end a window, whatever is clicked, after `exposures` of which none was lost."""
    last_shots = range(shots - 1, plan.shots_per_object, shots)
    exposure, nodes = 0, {0}
    while True:
        cycle, slot = divmod(exposure, plan.slots_per_cycle)
        nodes = {0} if slot == 0 else nodes
        planned = int(plan.slot_pattern[slot])
        ends = False
        if plan.automaton is None:
            same_shot = plan.slot_shot == plan.slot_shot[slot]
            shot = cycle % plan.cycles_per_object * plan.shots_per_cycle + int(plan.slot_shot[slot])
            ends = planned != DARK_PATTERN and shot in last_shots and slot == int(same_shot.nonzero()[0].max())
        elif planned == ADAPTIVE_PATTERN:
            clicks = range(plan.largest + 1) if exposure >= len(exposures) else [exposures[exposure][1]]
            states = {node for node in nodes if node < plan.automaton.n_states}
            nodes = {int(plan.automaton.successors[node][bit]) for node in states for bit in clicks}
            ends = any(node >= plan.automaton.n_states for node in nodes)
        if ends and exposure >= len(exposures):
            return exposure
        exposure += 1
