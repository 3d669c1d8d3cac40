"""An automaton: which pattern the next exposure shows, from the clicks so far, and the class probabilities of every node.

Arrays in, a checked `Automaton` out; also stopping by confidence or dose, and the plain NumPy walk that the kernels are compared with.
All checks are linear in the size, whatever the arrays hold; they raise ValueError with what, found and allowed.

A *node* is a state or a leaf: state s is node s, leaf l is node `n_states` + l. A *walk* begins in state 0; one exposure per state, until a
leaf is reached. With c channels a state shows c patterns at once, one for each, and an exposure has 2**c outcomes: bit k of the outcome is
the click of channel k. Of a detector that counts, outcome j is j photons, the last one that many or more.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.base.numbers import Range, demand

STATES_MAX = 65_533  # a state number is stamped into a u16 beside 0xFFFE (adaptive slot) and 0xFFFF (dark)
LEAVES_MAX = 1 << 20
SLOTS_MAX = 1024
CHANNELS_MAX = 4  # the outcomes of more are no number of COUNTS
COUNT_OUTCOMES = (3, 16)  # of a detector that counts; two are clicks
POSTERIOR_SUM_TOLERANCE = 1e-5
DWELL_STEPS_RANGE = Range(1, 65_535, whole=True)
CONFIDENCE_RANGE = Range(1e-6, 1.0)
DOSE_PARTS = 64  # of the cap, to which the doses of walks that meet are told apart
DOSE_ROUNDING = 1e-9  # of a cap: sums of light come in another order here than elsewhere
DOSE_RANGE, STATES_RANGE = Range(1e-9, 1e15), Range(1, STATES_MAX, whole=True)
GOLDEN_NODES = 512  # nodes, evenly spread, to which a golden walk leads
LEAST_POSTERIOR = 1e-30  # of a score, so that it is finite: scores are log posteriors
_EDGES_AT_ONCE = 1 << 20  # explored together, so that memory stays small
_UNREACHED = 0xFFFF  # as a depth: above SLOTS_MAX


@dataclass(frozen=True, slots=True, eq=False)
class Automaton:
    """States are numbered so that every successor is higher than its state; the walk begins in state 0.

    A successor s >= n_states is the leaf s - n_states. Any integer or float arrays are taken; they are kept read-only in the types below.
    A state is reached after one number of exposures only, its `depth`: the slot in which it is shown. ValueError says what is impossible.

    >>> flip = Automaton(
    ...     pattern=[0, 1], dwell=[1, 1], dwell_steps=1, successors=[[1, 2], [2, 3]],
    ...     posteriors=[[0.5, 0.5], [0.5, 0.5], [0.9, 0.1], [0.2, 0.8]],
    ... )
    >>> flip.n_states, flip.n_leaves, flip.n_slots, flip.depth.tolist()
    (2, 2, 2, [0, 1])
    """

    # (states,) row of Bundle.pattern_levels that the state shows, of several channels the first of as many rows; states may share them
    pattern: NDArray[np.uint16]
    dwell: NDArray[np.uint16]  # (states,) the light is on for dwell / dwell_steps of the exposure, 1..dwell_steps
    dwell_steps: int  # 1: one time for all
    successors: NDArray[np.uint32]  # (states, outcomes): outcome 0 no click, 1 click; 2**c outcomes of c channels
    posteriors: NDArray[np.float32]  # (states + leaves, classes) class probabilities in each node; rows sum to 1
    counts: bool = False  # outcomes are photon numbers of one detector, the last one "this many or more"
    depth: NDArray[np.uint16] = field(init=False)  # (states,) exposures before the state
    n_slots: int = field(init=False)  # T: exposures of the longest walk

    def __post_init__(self) -> None:
        DWELL_STEPS_RANGE.checked(self.dwell_steps, "dwell_steps")
        for name, dtype, axes in (("pattern", np.uint16, 1), ("dwell", np.uint16, 1), ("successors", np.uint32, 2)):
            object.__setattr__(self, name, _whole_numbers(getattr(self, name), np.dtype(dtype), axes, name))
        object.__setattr__(self, "posteriors", _read_only(np.asarray(self.posteriors), np.dtype(np.float32)))
        _check_sizes(self)
        _check_posteriors(self.posteriors)
        depth, unreached = _explored(self.successors, self.n_leaves)
        _demand_reached(unreached, self.n_states)
        object.__setattr__(self, "depth", _read_only(depth, np.dtype(np.uint16)))
        object.__setattr__(self, "n_slots", int(depth.max()) + 1)

    @property
    def n_states(self) -> int:
        """Number of states."""
        return len(self.successors)

    @property
    def n_leaves(self) -> int:
        """Number of leaves."""
        return len(self.posteriors) - len(self.successors)

    @property
    def n_classes(self) -> int:
        """Number of classes."""
        return int(self.posteriors.shape[1])

    @property
    def n_outcomes(self) -> int:
        """Number of outcomes of one exposure: 2**c, or the photon numbers told apart."""
        return int(self.successors.shape[1])

    @property
    def largest(self) -> int:
        """The largest number that a channel can have in one exposure: 1 of clicks."""
        return self.n_outcomes - 1 if self.counts else 1

    @property
    def channels(self) -> int:
        """Number of channels that are read at once, c; one where photons are counted."""
        return 1 if self.counts else self.n_outcomes.bit_length() - 1

    @property
    def rows(self) -> NDArray[np.int64]:
        """Rows of Bundle.pattern_levels that each state shows, (states, channels): row k is for channel k."""
        return self.pattern.astype(np.int64)[:, None] + np.arange(self.channels)

    @property
    def n_bits(self) -> int:
        """Numbers of a click word, `channels` per slot: t * channels + k is the click of channel k in slot t, or t its photon number."""
        return self.n_slots * self.channels


def reachable_automaton(
    pattern: ArrayLike,
    dwell: ArrayLike,
    dwell_steps: int,
    successors: ArrayLike,
    posteriors: ArrayLike,
    counts: bool = False,
) -> Automaton:
    """Return the automaton of these arrays without the states and leaves that no walk reaches; ValueError as `Automaton`."""
    states, nodes = np.asarray(successors), np.asarray(posteriors)
    n_states, n_nodes = len(states), len(nodes)
    demand(states.ndim == 2 and nodes.ndim == 2, "successors and posteriors must have two axes")
    _check_order(states, n_states, n_nodes)
    _, unreached = _explored(states, n_nodes - n_states)
    kept = np.flatnonzero(~unreached)
    number = np.zeros(n_nodes, np.int64)
    number[kept] = np.arange(len(kept))
    shown = kept[kept < n_states]
    of_states = np.asarray(pattern)[shown], np.asarray(dwell)[shown], dwell_steps, number[states[shown]]
    return Automaton(*of_states, nodes[kept], counts)


def stopped(automaton: Automaton, confidence: float) -> Automaton:
    """Return the automaton that decides as soon as a state is sure: an edge into one whose largest posterior is at least `confidence`
    leads to a leaf with that state's posterior. State 0 is always shown. What is no longer reached is left out; ValueError beyond (0, 1].
    """
    CONFIDENCE_RANGE.checked(confidence, "confidence")
    n_states, n_nodes = automaton.n_states, len(automaton.posteriors)
    sure = automaton.posteriors[:n_states].max(axis=1) >= np.float32(confidence)
    sure[0] = False
    leads_to = np.arange(n_nodes)
    leads_to[:n_states][sure] = n_nodes + np.arange(np.count_nonzero(sure))
    shown = automaton.pattern, automaton.dwell, automaton.dwell_steps
    posteriors = np.concatenate([automaton.posteriors, automaton.posteriors[:n_states][sure]])
    return reachable_automaton(*shown, leads_to[automaton.successors], posteriors, automaton.counts)


def walk_nodes(automaton: Automaton, words: NDArray[Any]) -> NDArray[np.uint32]:
    """Return the node in each slot, uint32 (n, n_slots + 1), of click words of zeros and ones (n, n_bits); the leaf is repeated to the end.

    Bit t * channels + k is the click of channel k in slot t; where photons are counted, number t is theirs. What follows the leaf does
    not matter.
    """
    n_states, channels = automaton.n_states, automaton.channels
    bits = words.astype(np.uint32).reshape(len(words), automaton.n_slots, channels)
    outcomes = (bits << np.arange(channels, dtype=np.uint32)).sum(axis=2, dtype=np.uint32)
    nodes = np.zeros((len(words), automaton.n_slots + 1), np.uint32)
    for slot in range(automaton.n_slots):
        here = nodes[:, slot]
        going = here < n_states
        nodes[:, slot + 1] = here
        nodes[going, slot + 1] = automaton.successors[here[going], outcomes[going, slot]]
    return nodes


def words_to(automaton: Automaton, nodes: NDArray[Any]) -> NDArray[np.float32]:
    """Return one click word per node of `nodes` that leads to it, float32 (n, n_bits), zeros beyond."""
    n_nodes, outcomes = len(automaton.posteriors), automaton.n_outcomes
    edge = np.full(n_nodes, -1, np.int64)
    edge[automaton.successors.reshape(-1)] = np.arange(automaton.successors.size)
    bits = np.zeros((len(nodes), automaton.n_slots, automaton.channels), np.float32)
    row, here = np.arange(len(nodes)), np.asarray(nodes, np.int64)
    while (moving := here > 0).any():
        row, here = row[moving], here[moving]
        state, outcome = np.divmod(edge[here], outcomes)
        slot = automaton.depth[state].astype(np.int64)
        clicks = outcome[:, None] >> np.arange(automaton.channels) & 1
        bits[row, slot] = outcome[:, None] if automaton.counts else clicks
        here = state
    return bits.reshape(len(nodes), automaton.n_bits)


def golden_nodes(automaton: Automaton) -> NDArray[np.int64]:
    """Return nodes that golden walks lead to: at most `GOLDEN_NODES`, evenly spread, the last leaf among them."""
    last = len(automaton.posteriors) - 1
    return np.unique(np.linspace(1, last, min(last, GOLDEN_NODES)).round().astype(np.int64))


def log_scores(posteriors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return scores of posteriors (n, classes), float32: their logarithms, at least log(1e-30)."""
    return np.log(np.maximum(posteriors, np.float32(LEAST_POSTERIOR)))


def walk_difference(automaton: Automaton, words: NDArray[Any], walks: NDArray[Any]) -> str:
    """Return what differs between golden walks (n, n_slots + 1) and the automaton's, or "" if nothing does."""
    found = walk_nodes(automaton, words)
    if found.shape != walks.shape:
        return f"golden walks of shape {walks.shape}, expected {found.shape}"
    differs = (found != walks).any(axis=1)
    if not differs.any():
        return ""
    row = int(differs.argmax())
    slot = int((found[row] != walks[row]).argmax())
    there = f"golden walk {row} is at node {walks[row, slot]} after {slot} exposures"
    return f"{there}, the automaton at {found[row, slot]}"


def greatest_light(automaton: Automaton, light: NDArray[np.float64]) -> float:
    """Return the most light that one walk can take, of the light of each state, float64 (states,)."""
    most = np.zeros(len(automaton.posteriors))
    for states in _slots_backwards(automaton):
        most[states] = light[states] + most[automaton.successors[states]].max(axis=1)
    return float(most[0])


def exposures_to_leaf(automaton: Automaton) -> NDArray[np.int64]:
    """Return the fewest exposures from each state to a leaf, that of the state included, int64 (states,)."""
    fewest = np.zeros(len(automaton.posteriors), np.int64)
    for states in _slots_backwards(automaton):
        fewest[states] = 1 + fewest[automaton.successors[states]].min(axis=1)
    return fewest[: automaton.n_states]


def _slots_backwards(automaton: Automaton) -> Iterator[NDArray[np.int64]]:
    """Yield the states of each slot, those of the last slot first."""
    order = np.argsort(automaton.depth, kind="stable")
    ends = np.searchsorted(automaton.depth[order], np.arange(automaton.n_slots + 1))
    for slot in range(automaton.n_slots - 1, -1, -1):
        yield order[ends[slot] : ends[slot + 1]]


@dataclass(frozen=True, slots=True)
class DoseCap:
    """The most light that one walk may bring, and the most states of the automaton that keeps it."""

    most: float
    states: int = STATES_MAX

    def __post_init__(self) -> None:
        DOSE_RANGE.checked(self.most, "dose cap")
        STATES_RANGE.checked(self.states, "states within a dose cap")


def capped(automaton: Automaton, light: ArrayLike, cap: float, most_states: int = STATES_MAX) -> Automaton:
    """Return the automaton whose walks never pass a dose: where the next state would, the walk ends with that state's posterior.

    `light` float (states,) is what each state brings, at least 0; `cap` the most that one walk may bring. A state that is reached with
    several doses is parted by them, into as many states as `most_states` allows; those of one part go by their largest dose, so that
    no walk ever passes the cap. ValueError where the first state alone does.
    """
    dose = np.asarray(light, np.float64)
    fits = dose.shape == (automaton.n_states,) and bool((dose >= 0).all() and np.isfinite(dose).all())
    demand(fits, f"light of shape {dose.shape} for {automaton.n_states} states, allowed: one number of 0 or more each")
    demand(bool(dose[0] <= cap), f"the first exposure brings {dose[0]:.6g}, the dose may not pass {cap:.6g}")
    parts = DOSE_PARTS
    while True:
        levels, edges = _parted(automaton, dose, cap, parts)
        kept = _joined(levels, edges)
        if sum(len(rows) for rows in kept) <= max(most_states, automaton.n_states) or parts == 1:
            return _numbered(kept, automaton)
        parts //= 2


def _parted(
    automaton: Automaton, light: NDArray[np.float64], cap: float, parts: int
) -> tuple[list[NDArray[np.int64]], list[NDArray[np.int64]]]:
    """The states of each slot in at most `parts` parts of equal width in dose, and where each of them leads."""
    n_states = automaton.n_states
    levels = [(np.zeros(1, np.int64), np.zeros(1))]  # states, and the dose before each
    edges = []  # of each level: an entry of the next one, or -1 - the node at which the walk ends
    while len(levels[-1][0]):
        state, before = levels[-1]
        after = automaton.successors[state].astype(np.int64)
        reached = np.broadcast_to((before + light[state])[:, None], after.shape)
        goes_on = after < n_states
        goes_on[goes_on] = reached[goes_on] + light[after[goes_on]] <= cap * (1 + DOSE_ROUNDING)
        part = np.minimum((reached[goes_on] / max(cap, 1e-300) * parts).astype(np.int64), parts - 1)
        keys, entry = np.unique(after[goes_on] * parts + part, return_inverse=True)
        most = np.zeros(len(keys))
        np.maximum.at(most, entry.reshape(-1), reached[goes_on])
        edge = -1 - after
        edge[goes_on] = entry.reshape(-1)
        edges.append(edge)
        levels.append((keys // parts, most))
    return [state for state, _ in levels[:-1]], edges


def _joined(states: list[NDArray[np.int64]], edges: list[NDArray[np.int64]]) -> list[NDArray[np.int64]]:
    """The entries of each slot, rows of a state and where it leads; those of a slot that do the same are one, from the last slot up."""
    kept: list[NDArray[np.int64]] = []
    number = np.zeros(0, np.int64)
    for state, edge in zip(reversed(states), reversed(edges)):
        inner = edge >= 0
        edge[inner] = number[edge[inner]]
        rows, number = np.unique(np.column_stack([state, edge]), axis=0, return_inverse=True)
        number = number.reshape(-1)
        kept.insert(0, rows)
    return kept


def _numbered(kept: list[NDArray[np.int64]], automaton: Automaton) -> Automaton:
    """The automaton of the entries of each slot."""
    starts = np.cumsum([0, *(len(rows) for rows in kept)])
    total = int(starts[-1])
    successors = []
    for start, rows in zip(starts[1:], kept):
        edge = rows[:, 1:]
        successors.append(np.where(edge >= 0, edge + start, total - 1 - edge))
    entries = np.concatenate([rows[:, 0] for rows in kept])
    shown = automaton.pattern[entries], automaton.dwell[entries], automaton.dwell_steps
    posteriors = np.concatenate([automaton.posteriors[entries], automaton.posteriors])
    return reachable_automaton(*shown, np.concatenate(successors), posteriors, automaton.counts)


def _read_only(array: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """A read-only array in C order; copied where the caller could still write to it."""
    if array.dtype == dtype and array.flags.c_contiguous and not array.flags.writeable:
        return array
    with np.errstate(over="ignore", invalid="ignore"):  # what float32 cannot hold becomes inf, and is refused later
        own = np.array(array, dtype=dtype, order="C")
    own.flags.writeable = False
    return own


def _whole_numbers(values: Any, dtype: np.dtype[Any], axes: int, name: str) -> NDArray[Any]:
    array = np.asarray(values)
    fits = array.ndim == axes and array.dtype.kind in "iu" and array.size > 0
    wanted = "(states,)" if axes == 1 else "(states, outcomes)"
    demand(fits, f"{name} is {array.dtype} {array.shape}, allowed: integers {wanted}")
    low, high, top = int(array.min()), int(array.max()), int(np.iinfo(dtype).max)
    demand(low >= 0 and high <= top, f"{name} runs from {low} to {high}, allowed: 0 to {top}")
    return _read_only(array, dtype)


def _check_sizes(automaton: Automaton) -> None:
    states, outcomes = automaton.successors.shape
    demand(1 <= states <= STATES_MAX, f"{states} states, allowed: 1 to {STATES_MAX}")
    if automaton.counts:
        low, high = COUNT_OUTCOMES
        demand(low <= outcomes <= high, f"{outcomes} photon numbers per exposure, allowed: {low} to {high}")
    else:
        fits = outcomes == 1 << automaton.channels and 1 <= automaton.channels <= CHANNELS_MAX
        demand(fits, f"{outcomes} outcomes per exposure, allowed: 2**c of c channels, c from 1 to {CHANNELS_MAX}")
    for name in ("pattern", "dwell"):
        shape = getattr(automaton, name).shape
        demand(shape == (states,), f"{name} has shape {shape} for {states} states")
    low, high = int(automaton.dwell.min()), int(automaton.dwell.max())
    steps = automaton.dwell_steps
    demand(low >= 1 and high <= steps, f"dwell runs from {low} to {high}, allowed: 1 to dwell_steps = {steps}")
    posteriors = automaton.posteriors
    demand(posteriors.ndim == 2, f"posteriors have shape {posteriors.shape}, allowed: (states + leaves, classes)")
    leaves = len(posteriors) - states
    demand(1 <= leaves <= LEAVES_MAX, f"{leaves} leaves, allowed: 1 to {LEAVES_MAX}")
    demand(posteriors.shape[1] >= 2, f"posteriors of {posteriors.shape[1]} classes, allowed: 2 or more")
    _check_order(automaton.successors, states, len(posteriors))


def _check_order(successors: NDArray[Any], n_states: int, n_nodes: int) -> None:
    demand(0 < n_states < n_nodes, f"{n_states} states and {n_nodes} nodes, allowed: at least one state and one leaf")
    high = int(successors.max())
    demand(high < n_nodes, f"a successor is {high}, allowed: 0 to {n_nodes - 1} (states, then leaves)")
    lowest = successors.min(axis=1)
    state = int((lowest <= np.arange(n_states)).argmax())
    found = f"state {state} has the successors {successors[state].tolist()}"
    demand(bool(lowest[state] > state), f"{found}, allowed: above {state}")


def _check_posteriors(posteriors: NDArray[np.float32]) -> None:
    low, high = float(posteriors.min()), float(posteriors.max())  # a NaN is minimum and maximum
    demand(low >= 0 and high <= 1, f"posteriors run from {low:g} to {high:g}, allowed: 0 to 1")
    error = np.abs(posteriors.sum(axis=1, dtype=np.float64) - 1.0)
    node = int(error.argmax())
    message = f"the posterior of node {node} sums to 1 within {error[node]:.3g}, allowed: {POSTERIOR_SUM_TOLERANCE:g}"
    demand(bool(error[node] <= POSTERIOR_SUM_TOLERANCE), message)


def _explored(successors: NDArray[Any], n_leaves: int) -> tuple[NDArray[np.uint16], NDArray[np.bool_]]:
    """Return the depth of every state and which nodes (states, then leaves) no walk reaches; ValueError for two depths of one state.

    Level by level. Each state is gone through once, as none may come back at another depth.
    """
    n_states, outcomes = successors.shape
    depth = np.full(n_states, _UNREACHED, np.uint16)
    unreached = np.ones(n_states + n_leaves, np.bool_)
    shown_next = np.zeros(n_states, np.bool_)
    frontier, level, step = np.zeros(1, np.int64), 0, max(1, _EDGES_AT_ONCE // outcomes)
    while frontier.size:
        demand(level < SLOTS_MAX, f"walks of more than {SLOTS_MAX} exposures, allowed: at most {SLOTS_MAX}")
        twice = depth[frontier] != _UNREACHED
        if twice.any():
            state = int(frontier[twice.argmax()])
            raise ValueError(f"state {state} is reached after {depth[state]} and after {level} exposures, allowed: one")
        depth[frontier] = level
        unreached[frontier] = False
        shown_next[:] = False
        for start in range(0, len(frontier), step):
            after = successors[frontier[start : start + step]].reshape(-1)
            unreached[after] = False
            shown_next[after[after < n_states]] = True
        frontier = np.flatnonzero(shown_next)
        level += 1
    return depth, unreached


def _demand_reached(unreached: NDArray[np.bool_], n_states: int) -> None:
    if unreached.any():
        node = int(unreached.argmax())
        name = f"state {node}" if node < n_states else f"leaf {node - n_states}"
        raise ValueError(f"no walk reaches {name} ({int(unreached.sum())} such nodes), allowed: every node is reached")
