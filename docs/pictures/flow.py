"""Draw docs/pictures/flow.png from a recording of `pans run --flow cells`: click sums, posteriors, marks, decisions, pulses (extra `plot`).

python docs/pictures/flow.py pans-runs/latest/run.pansrec [first exposure] [exposures]
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from pans.bundle.backends import NO_LABEL, make_decider
from pans.decide.flow import abort_reason, recorded_flow_core
from pans.protocol.wire import MessageType, decode_frames, decode_mark, unpack_body
from pans.record.reading import read_recording, sent_to_device
from pans_trainer.figures import new_figure, save_figure

recording = read_recording(Path(sys.argv[1]))
first = int(sys.argv[2]) if len(sys.argv) > 2 else 0
count = int(sys.argv[3]) if len(sys.argv) > 3 else 2400
config, bundle = recording.header["config"], recording.bundle()
sent = sent_to_device(recording)
plan = sent.plan(int(config["tick_hz"]), None, 1)
decider = make_decider(bundle)
arm = next(iter(sent.arms.values()))
core = recorded_flow_core(config["flow"], plan, decider, bundle, 1, arm.n_cycles)
core.begin(arm.start_tick, arm.n_cycles)
stop = first + count
words, marks, rows, gates = np.zeros(count, np.int64), [], [], {}
for _, body in recording.messages():
    frame = unpack_body(body)
    if frame.type == MessageType.MARK:
        mark = decode_mark(frame.payload)
        if first <= mark.exposure_index < stop:
            marks.append(mark)
    output = core.step(frame)
    rows += [(d, p) for d, p in zip(output.decisions, output.passages) if p.last > first and p.first < stop]
    gates |= {action.number: action.tick for action in output.actions}
    if frame.type == MessageType.FRAMES:
        block = decode_frames(frame.payload)
        at = np.arange(block.exposure_index, block.exposure_index + len(block.words))
        here = (at >= first) & (at < stop)
        packed = block.words[here].astype(np.int64)
        words[at[here] - first] = packed @ (1 << (8 * np.arange(packed.shape[1])))
        if block.exposure_index > stop + 1000:
            break

period_us = plan.slot_period_ticks * plan.tick_us
time_us = (first + np.arange(count)) * period_us
clicks = np.array([word.bit_count() for word in words.tolist()])
width = core.limits.onset_frames
sums = np.convolve(clicks, np.ones(width), "full")[:count]
bits = (words[:, None] >> np.arange(bundle.n_features)) & 1
scores = decider.scores_batch(bits, 1).astype(np.float64)
posterior = np.exp(scores - scores.max(axis=1, keepdims=True))
posterior /= posterior.sum(axis=1, keepdims=True)
smooth = np.stack([np.convolve(p, np.ones(5) / 5, "same") for p in posterior.T], axis=1)
smooth[sums <= core.limits.release_clicks] = np.nan

colours = plt.cm.tab10.colors
plt.rcParams["font.size"] = 13
fig, (top, middle, bottom) = new_figure(8.9, 8.4, panels=1, rows=3)
top.plot(time_us, sums, color="0.25", lw=0.9)
top.axhline(
    core.limits.onset_clicks,
    color="tab:green",
    lw=0.8,
    ls="--",
    label=f"onset: {core.limits.onset_clicks} clicks",
)
for place, (decision, passage) in enumerate(rows):
    top.axvspan(passage.first * period_us, passage.last * period_us, color="tab:blue", alpha=0.10)
    at = (decision.exposure_index + 0.5) * period_us
    named = decision.label != NO_LABEL
    text = f"{bundle.classes[decision.label]}\n{decision.probability:.0%}" if named else abort_reason(decision.flags)
    top.axvline(at, color="tab:red", lw=1.0)
    top.text(at, sums.max() * (1.52 - 0.24 * (place % 2)), text, ha="center", va="top", fontsize=12, color="tab:red")
top.set_ylim(0, sums.max() * 1.56)
top.set_ylabel(f"clicks in {width} frames")
top.legend(loc="center", bbox_to_anchor=(0.54, 0.5))
for label, name in enumerate(bundle.classes):
    middle.plot(time_us, smooth[:, label], color=colours[label], lw=1.1, label=name)
middle.set_ylabel("posterior per frame\n(mean of 5)")
middle.legend(loc="center", bbox_to_anchor=(0.54, 0.5), fontsize=12)
for number, mark in enumerate(marks):
    span = (
        (mark.exposure_index - mark.half_exposures) * period_us,
        (mark.exposure_index + mark.half_exposures) * period_us,
    )
    bottom.plot(span, (2, 2), color=colours[mark.truth], lw=5, solid_capstyle="butt")
    bottom.text(sum(span) / 2, 2.15 + 0.3 * (number % 3), bundle.classes[mark.truth], ha="center")
for decision, passage in rows:
    leave = passage.last * period_us
    bottom.plot((leave, leave), (0.8, 1.2), color="tab:blue")
    if decision.number in gates:
        gate_us = (gates[decision.number] - arm.start_tick) * plan.tick_us
        bottom.annotate("", (gate_us, 1), (leave, 1), arrowprops={"arrowstyle": "->", "color": "tab:red"})
        bottom.text(gate_us, 0.35, "gate", color="tab:red", ha="center")
bottom.set_ylim(0, 3.2)
bottom.set_yticks((1, 2), ("release, pulse", "MARK: truth"))
bottom.set_xlabel("time, us")
for axis in (top, middle, bottom):
    axis.set_xlim(time_us[0], time_us[-1])
fig.suptitle(f"SIMULATED: {bundle.name}, a frame every {period_us:.3g} us")
save_figure(fig, Path(__file__).with_name("flow.png"))
