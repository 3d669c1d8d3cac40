"""The compiled kernels of what a call of the compiled turn brought: its decisions added up row by row, its blocks judged by the clock.

Owns the twins of `RunTally.add`, of `TimingLedger.judge` and of `ClockModel.to_host_ns` for many; tally.py, ledger.py and clock.py own
the sums and their meaning. Never allocates.
"""

from __future__ import annotations

import numpy as np

from pans.runtime.core.decision import NO_LABEL, DecisionFlag
from pans.runtime.core.stream_kernels import MARK_SLOTS
from pans.runtime.timing.clock import LARGEST_NS, STEP_MARGIN_NS
from pans.runtime.timing.ledger import SUB_BITS
from pans.runtime.wire.inner import inner, outer

from . import rings as ring

# sums, int64 (N_SUMS,), of the rows that a call has taken
CLICKS, EXPOSURES, PHOTONS_KNOWN, ABSTAINED, UNSURE, KNOWN, RIGHT, N_SUMS = range(8)
NUMBER, DECIDED, WELL = range(3)  # objects, int64 (n, 3): which one, its decisions, the right ones among them
# judged, int64 (N_JUDGED,): the longest of each stage and in total, the largest uncertainty, late decisions, those by slowest stage
LONGEST, UNCERTAINTY, LATE, BLAME, N_JUDGED = 0, 5, 6, 7, 10
# marked, int64 (n, N_MARKED): a block's number among the steps, when it ended and how unsure that is, and what is to be looked at
STEP, ENDED_NS, UNSURE_NS, LOOK, N_MARKED = range(5)
IS_LATE, IS_AHEAD = 1, 2
_ABSTAINED, _AMBIGUOUS = np.uint32(DecisionFlag.ABSTAINED), np.uint32(DecisionFlag.AMBIGUOUS)
_NO_LABEL, _U = NO_LABEL, np.uint64


@outer
def add_rows(rows, first, marked, photons_of, plan, sums, photons, tables):  # type: ignore[no-untyped-def]
    """Add rows, DECISION_DTYPE (n,), from `first` on to what decisions add up to; return up to where, and how many runs of one object.

    `tables` are table, trials and objects. It ends before a row for which `objects` or `trials` have no room.

    marked int64 and photons_of float32 (MARK_SLOTS,): MarkArrays; plan int64 (2,): K and after how many objects the first one is shown
    again (0: never). photons float64 (1,), table int64 (classes, classes) and trials int64 (m, 2) are added to. sums int64 (N_SUMS,) are
    of these rows alone, and objects int64 (n, 3) is filled from its beginning.
    """
    table, trials, objects = tables
    numbers, shots, clicks, labels = rows["object"], rows["shot"], rows["clicks"], rows["label"]
    truths, flags, walked = rows["truth"], rows["flags"], rows["exposures"]
    n_clicks, n_walked, n_right = np.int64(0), np.int64(0), np.int64(0)
    n_photons, n_silent, n_unsure, n_known = np.int64(0), 0, 0, np.int64(0)
    total, per_decision, object_before, n_objects = photons[0], plan[0], np.int64(-1), 0
    i, n, room = np.int64(first), np.int64(rows.size), objects.shape[0]
    while i < n and n_objects < room:  # the decisions in a row on one object share all that it tells
        begun, number, truth, well, following = i, np.int64(numbers[i]), np.int64(truths[i]), np.int64(0), np.int64(-1)
        slot, trial, light = number % MARK_SLOTS, np.int64(0), np.float64(np.nan)
        if marked[slot] == number:
            light = np.float64(photons_of[slot]) * per_decision
        lit, known = not np.isnan(light), 0 <= truth < table.shape[0]
        while i < n and numbers[i] == number and truths[i] == truth:
            label = np.int64(labels[i])
            if known:
                shot = np.int64(shots[i])
                trial = trial + 1 if shot == following else shot // per_decision  # a division for each would show
                if trial >= trials.shape[0]:
                    room = 0
                    break
                following = shot + per_decision
            n_clicks += np.int64(clicks[i])
            n_walked += np.int64(walked[i])
            if lit:
                total += light
            if flags[i] & _ABSTAINED or label == _NO_LABEL:
                n_silent += 1
                n_unsure += (flags[i] & _AMBIGUOUS) != 0
            if known:
                right = np.int64(label == truth)
                if label != _NO_LABEL:
                    table[_U(truth), _U(label)] += 1
                trials[_U(trial), 0] += 1
                trials[_U(trial), 1] += right
                well += right
            i += 1
        if lit:
            n_photons += i - begun
        if not known or i == begun:
            continue
        n_known += i - begun
        n_right += well
        n_objects, object_before = _note_object(number, i - begun, well, plan, objects, n_objects, object_before)
    photons[0] = total
    sums[CLICKS], sums[EXPOSURES], sums[PHOTONS_KNOWN], sums[ABSTAINED] = n_clicks, n_walked, n_photons, n_silent
    sums[UNSURE], sums[KNOWN], sums[RIGHT] = n_unsure, n_known, n_right
    return i, n_objects


@outer
def add_numbered(numbered, first, marked, photons_of, plan, sums, photons, tables):  # type: ignore[no-untyped-def]
    """As `add_rows`, of NumberedDecisions: its verdicts, numbers and runs. It ends before a run for which there is no room."""
    (verdicts, numbers, runs), (table, trials, objects) = numbered, tables
    n_clicks, n_photons, n_silent, n_unsure = np.int64(0), np.int64(0), np.int64(0), np.int64(0)
    n_known, n_right, total, per_decision = np.int64(0), np.int64(0), photons[0], plan[0]
    i, object_before, n_objects = np.int64(first), np.int64(-1), 0
    while i < numbers.size and n_objects < objects.shape[0]:
        run, light, well = runs[i], np.float64(np.nan), np.int64(0)
        stop, number, truth = i + np.int64(run["count"]), np.int64(run["object"]), np.int64(run["truth"])
        trial, step = np.int64(run["shot"]) // per_decision, np.int64(run["shot_step"]) // per_decision
        slot, known = number % MARK_SLOTS, 0 <= truth < table.shape[0]
        if known and trial + (stop - i - 1) * step >= trials.shape[0]:
            break
        if marked[slot] == number:
            light = np.float64(photons_of[slot]) * per_decision
        lit = not np.isnan(light)
        if lit:
            n_photons += stop - i
        for k in range(_U(i), _U(stop)):
            if lit:
                total += light  # one by one: a sum of floats depends on its order
            verdict = verdicts[numbers[k]]
            label = np.int64(verdict["label"])
            n_clicks += np.int64(verdict["clicks"])
            if label == _NO_LABEL:
                n_silent += 1
                n_unsure += (verdict["flags"] & _AMBIGUOUS) != 0
            if known:
                right = np.int64(label == truth)
                if label != _NO_LABEL:
                    table[_U(truth), _U(label)] += 1
                trials[_U(trial), 0] += 1
                trials[_U(trial), 1] += right
                well += right
                trial += step
        if known:
            n_known += stop - i
            n_right += well
            n_objects, object_before = _note_object(number, stop - i, well, plan, objects, n_objects, object_before)
        i = stop
    photons[0] = total
    sums[CLICKS], sums[EXPOSURES], sums[PHOTONS_KNOWN], sums[ABSTAINED] = n_clicks, 0, n_photons, n_silent
    sums[UNSURE], sums[KNOWN], sums[RIGHT] = n_unsure, n_known, n_right
    return i, n_objects


@inner
def _note_object(number, decided, well, plan, objects, n_objects, before):  # type: ignore[no-untyped-def]
    """Add decisions on an object to the last of `objects`, or to a new one; return how many there are, and which one is the last."""
    which = number % plan[1] if plan[1] else number
    if which != before:
        objects[n_objects, NUMBER], objects[n_objects, DECIDED], objects[n_objects, WELL] = which, 0, 0
        n_objects += 1
    objects[n_objects - 1, DECIDED] += decided
    objects[n_objects - 1, WELL] += well
    return n_objects, which


@outer
def judge_blocks(steps, first, fit, anchors, deadline_ns, histograms, judged, runs, marked):  # type: ignore[no-untyped-def]
    """Judge the times of the decisions, from number `first` on, of many blocks, `steps` int64 (n, N_STEP).

    Returns how many runs and how many marked blocks there are.

    fit: ClockModel.numbers, int64 (2,) and float64 (2,); anchors: its anchors, int64 (k,) and float64 (k,); histograms: the counts of four
    stages and of the total, int64 each, and judged int64 (N_JUDGED,) are added to. runs TIMING_RUN_DTYPE (n,): one for each block with
    decisions. marked int64 (n, N_MARKED): late blocks, and those whose end lies in the future, which may have no decisions.
    """
    tick_0, host_0, ns_per_tick, rate = fit[0][0], fit[0][1], fit[1][0], fit[1][1]
    at, bounds = anchors
    n_runs, n_marked, before = 0, 0, np.int64(0)
    for i in range(steps.shape[0]):
        arrival_ns, elapsed = steps[i, ring.ARRIVAL], steps[i, ring.END_TICK] - tick_0
        away = min(max(np.rint(elapsed * ns_per_tick), -np.float64(LARGEST_NS)), np.float64(LARGEST_NS))
        end_ns = max(-LARGEST_NS, min(host_0 + np.int64(away), LARGEST_NS))
        unsure = bounds[0] + abs(elapsed - at[0]) * rate
        for k in range(1, at.size):
            unsure = min(unsure, bounds[k] + abs(elapsed - at[k]) * rate)
        unsure_ns = np.int64(min(unsure, np.float64(LARGEST_NS - 1))) + 1
        look = IS_AHEAD if end_ns - unsure_ns - STEP_MARGIN_NS > arrival_ns else 0
        count = steps[i, ring.ROWS] - before
        if count:
            if end_ns - unsure_ns > arrival_ns:  # what has arrived has happened
                end_ns = arrival_ns
            marks = (end_ns, arrival_ns, steps[i, ring.DECODED], steps[i, ring.DECIDED], steps[i, ring.RECORDED])
            if _judge(marks, count, unsure_ns, deadline_ns, histograms, judged):
                look |= IS_LATE
            run = runs[n_runs]
            run["index"], run["count"] = first + before, count
            run["device_end_ns"], run["arrival_ns"], run["decided_ns"], run["recorded_ns"] = (
                end_ns,
                arrival_ns,
                marks[3],
                marks[4],
            )
            n_runs, before = n_runs + 1, before + count
        if look:
            marked[n_marked, STEP], marked[n_marked, ENDED_NS] = i, end_ns
            marked[n_marked, UNSURE_NS], marked[n_marked, LOOK] = unsure_ns, look
            n_marked += 1
    return n_runs, n_marked


@inner
def _judge(marks, count, unsure_ns, deadline_ns, histograms, judged):  # type: ignore[no-untyped-def]
    """Count the stages and the total of a block's `count` decisions; whether they are late."""
    slowest, longest_ns = 0, marks[1] - marks[0]
    for stage in range(5):
        step_ns = marks[3] - marks[0] if stage == 4 else marks[stage + 1] - marks[stage]
        if stage < 3 and step_ns > longest_ns:
            slowest, longest_ns = stage, step_ns
        value, shift = max(step_ns, np.int64(0)), np.int64(0)
        while value >> shift >> SUB_BITS >> 1:
            shift += 1
        histograms[stage][(shift << SUB_BITS) + (value >> shift)] += count
        judged[LONGEST + stage] = max(judged[LONGEST + stage], value)
    judged[UNCERTAINTY] = max(judged[UNCERTAINTY], unsure_ns)
    late = marks[3] - marks[0] - unsure_ns > deadline_ns
    if late:
        judged[LATE] += count
        judged[BLAME + slowest] += count
    return late
