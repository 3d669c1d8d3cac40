"""Draws docs/pictures/late-decision.png: the evidence behind one late decision, for a link, a device and a host that are late. SIMULATED.

python docs/pictures/late_decision.py        (extra `plot`)
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt

from pans.bundle.backends import make_decider
from pans.decide.still import Core
from pans.live.loop import Job, run_live
from pans.live.options import RunOptions
from pans.live.timing import IDLE, OVERSLEPT, Facts, Verdict, causes
from pans_sim.ports.serve import open_sim
from pans_sim.testing import small_setup
from pans_trainer.figures import new_figure, save_figure

CASES = {
    "stall:60ms/400ms": "the link stalls",
    "late:60ms/400ms": "the device is late",
    "pause:60ms/400ms": "the host stands still",
}
COLOURS = {"late": "#b03030", IDLE: "#9ecae1", OVERSLEPT: "#f0a030"}
MS = 1e6


def witnessed(faults: str) -> tuple[Facts, Verdict]:
    """Return what was known about the first late decision of a run in virtual time, and the verdict."""
    heard: list[tuple[Facts, Verdict]] = []
    judge = causes.judge

    def listen(facts: Facts) -> Verdict:
        verdict = judge(facts)
        heard.append((facts, verdict))
        return verdict

    profile, bundle, plan = small_setup("sequential")
    config = RunOptions(n_cycles=4000, deadline_us=10_000.0, realtime=False)
    core = Core(plan, make_decider(bundle, backend="table"), 1, config.n_cycles)
    causes.judge = listen
    try:
        run_live(
            open_sim(f"sim:ideal?scene=uniform&pace=fast&seed=2&faults={faults}"),
            Job(profile, bundle, plan, config),
            core,
        )
    finally:
        causes.judge = judge
    return heard[0]


def draw(axis: plt.Axes, title: str, facts: Facts, verdict: Verdict) -> None:
    """Draw one case: time after the end of the exposure, one lane for each witness."""
    start = facts.begin_ns

    def bar(lane: int, begin: float, end: float, colour: str) -> None:
        first, last = max((begin - start) / MS, -6), (end - start) / MS
        axis.barh(lane, last - first, left=first, height=0.55, color=colour)

    bar(3, facts.begin_ns, facts.end_ns, COLOURS["late"])
    for span in facts.spans:
        bar(2, span.begin_ns, min(span.end_ns, facts.end_ns), COLOURS.get(span.kind, "#777777"))
    for probe in facts.stamped:
        if probe.sent_ns is None or probe.reached_ns is None:
            continue
        points = [(probe.sent_ns, 1), (probe.reached_ns, 0), (probe.left_ns, 0), (probe.arrival_ns, 1)]
        axis.plot(
            [(at - start) / MS for at, _ in points], [lane for _, lane in points], "o-", color="#2a6f3a", ms=4, lw=1.2
        )
    axis.axvline(10.0, color="#555555", ls=":", lw=1)
    axis.text(10.6, 3.42, "deadline", fontsize=12, color="#555555")
    axis.set_yticks([0, 1, 2, 3], ["device", "probe", "loop", "decision due"])
    axis.set_ylim(-0.6, 4.0)
    axis.set_xlim(-6, 68)
    axis.set_title(f"{title}: named “{verdict.cause}”{'' if verdict.sure else ' (not sure)'}", fontsize=15, loc="left")


def main() -> None:
    """Draw all cases beside the script."""
    plt.rcParams["font.size"] = 14
    figure, axes = new_figure(8.9, 8.6, panels=1, rows=len(CASES))
    for axis, (faults, title) in zip(axes, CASES.items()):
        draw(axis, title, *witnessed(faults))
    axes[-1].set_xlabel("time after the end of the exposure (ms)")
    names = {"late": "not decided yet", IDLE: "awake, waits for bytes", OVERSLEPT: "slept beyond its timer"}
    handles = [plt.Rectangle((0, 0), 1, 1, color=COLOURS[key], label=name) for key, name in names.items()]
    handles.append(plt.Line2D([], [], color="#2a6f3a", marker="o", ms=4, label="clock probe, there and back"))
    figure.legend(handles=handles, loc="outside lower center", ncol=2, frameon=False)
    figure.suptitle("SIMULATED: what the host knows about one late decision", fontsize=16)
    save_figure(figure, Path(__file__).with_name("late-decision.png"))


if __name__ == "__main__":
    main()
