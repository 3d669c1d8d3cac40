"""The one table of a run's figures: key, unit, meaning, allowed values, words and formats, Prometheus name, and where each is shown.

In: nothing. Out: `FIGURES`, which summary, pages, live view, state file, metrics, comparison, exports and the reference page read; and
`DecisionFigures`, what decisions add up to. A new figure is a row of the table, and a property of `DecisionFigures` if it follows from
those. Nothing large is loaded: the process that draws the live view uses this.

>>> FIGURES["clicks_mean"].text(8.8304)
'8.830'
>>> [one.key for one in shown(Shown.INDEX)]
['clicks_mean', 'photons_mean', 'illumination', 'late']
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Flag, auto
from functools import reduce
from string import Formatter
from typing import Any

from .denominators import GROUPS, group_of
from .ranges import AMOUNT, COUNT, END_OF_INTERVAL, OBJECTS, SHARE, SIGNED, Each, Range

LIGHT = ("clicks", "photons", "photons_known")  # sums over each group of decisions


# ---- what decisions add up to ----


@dataclass(frozen=True, slots=True)
class DecisionFigures:
    """What decisions add up to; None where it is not known. Accuracy, clicks and photons are per decision of one group."""

    accuracy: float | None
    decisions: int
    decided: int  # not abstained
    judged: int  # of these with a known true class
    abstained: int
    clicks_mean: float | None
    photons_mean: float | None
    photons_known: int  # decisions of the group whose photons are known: `photons_mean` is of these
    figures_of: dict[str, str]  # key -> its group (denominators.GROUPS)


def decision_figures(sums: Mapping[str, Any]) -> DecisionFigures:
    """Return the figures of `sums`: `right`, the decisions of each group, and `GROUP_clicks`, `GROUP_photons`, `GROUP_photons_known`."""
    counts = {name: sums[name] for name in GROUPS}
    group = group_of(counts)
    clicks, photons, known = (sums[f"{group}_{name}"] for name in LIGHT)
    return DecisionFigures(
        accuracy=sums["right"] / sums["judged"] if sums["judged"] else None,
        **counts,
        abstained=sums["decisions"] - sums["decided"],
        clicks_mean=clicks / counts[group] if counts[group] else None,
        photons_mean=photons / known if known else None,
        photons_known=known,
        figures_of={"accuracy": "judged", **dict.fromkeys(("clicks_mean", "photons_mean", "illumination"), group)},
    )


# ---- the table ----


class Shown(Flag):
    """Where a figure has a place of its own, besides the JSON, the state file and the metrics."""

    RESULTS = auto()  # row of the table of results: summary.md, the page of a run
    TIMED = auto()  # row of that page where time was real
    INDEX = auto()  # column of the page of a folder of runs
    TREND = auto()  # curve of that page
    LIVE = auto()  # row of the live view
    COMPARE = auto()  # row of `pans compare`
    CARD = auto()  # row of a run or a recording in a notebook
    EXPORT = auto()  # attribute of frames, about.json and Parquet files


NOWHERE = Shown(0)


class Part(Flag):
    """Which runs have a figure in their summary."""

    DECISIONS = auto()  # every run: attributes of TallyFigures
    FLOW = auto()  # runs with passing objects
    WALKS = auto()  # runs of an automaton
    RUN = auto()  # every run: attributes of Summary
    COMMAND = auto()  # `pans demo` and `pans run` add them to the printed summary


class Words(Formatter):
    """Texts with values in braces; None and NaN are "unknown"."""

    def format_field(self, value: Any, spec: str) -> str:
        return "unknown" if value is None or value != value else str(super().format_field(value, spec))


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure: its place in the summary, `part` and `key`, or only in the state file, `live`."""

    key: str  # of the summary's JSON; a dot leads into an object; the name of the attribute too
    meaning: str  # one sentence, Markdown; also the help of the metric
    part: Part | None = Part.RUN  # None: only in the state file
    allowed: Any = None  # shape of the value in a recorded summary (record.reading.recorded_facts); None: not checked
    unit: str = ""
    name: str = ""  # in a table
    word: str = ""  # in the head of a column
    form: str = "{}"  # of a table
    short: str = ""  # of one line among others; "" as `form`
    of: str = ""  # of which decisions it is: a group of denominators.GROUPS, or "figures_of", which names the group
    total: str = ""  # key of the count of which this count is a part: it is compared and drawn as a rate
    rate_unit: str = ""
    interval: bool = False  # a share with a 95 % Wilson interval in KEY_ci, of passing objects
    shown: Shown = NOWHERE
    compared: str = ""  # its name in the JSON of `pans compare`; "" as `key`
    live: str = ""  # key of the state file
    metric: str = ""  # Prometheus name
    counts: bool = False  # the metric is a counter
    label: str = ""  # of the metric, one sample for each key of the object
    more: str = ""  # the keys of an object and limits, for the reference page
    see: str = ""  # link from there

    def text(self, value: Any) -> str:
        """Return `value` in words, as in a table."""
        return Words().vformat(self.form, (value,), {})

    def brief(self, value: Any) -> str:
        """Return `value` in words, as in a line of several figures."""
        return Words().vformat(self.short or self.form, (value,), {})

    def value(self, facts: Mapping[str, Any], missing: Any = None) -> Any:
        """Return the value in `facts`, the JSON of a summary; `missing` where the key is not there."""
        *objects, last = self.key.split(".")
        return reduce(lambda one, key: one.get(key) or {}, objects, facts).get(last, missing)


def shown(where: Shown) -> Iterator[Figure]:
    """Yield the figures that have a place there, in the order of the table."""
    return (one for one in FIGURES.values() if where in one.shown)


def keys_of(part: Part) -> tuple[str, ...]:
    """Return the keys of a part of the summary, in their order."""
    return tuple(key for key, one in FIGURES.items() if one.part is part and "." not in key)


def live_figures() -> Iterator[Figure]:
    """Yield the figures of the state file, in the order of the table."""
    return (one for one in FIGURES.values() if one.live)


_DARK = {
    **{"exposures+": COUNT, "clicks+": COUNT, "per_exposure+": SHARE, "expected+": (None, AMOUNT)},
    **{"low+": END_OF_INTERVAL, "high+": END_OF_INTERVAL},
}
_QUANTILES = {f"{name}+": (None, AMOUNT) for name in ("p50", "p99", "p999", "max")}
_MEAN, _PART, _TEXT, _TEXTS = (None, AMOUNT), (None, SHARE), str, Each(list, str)
_COUNTS = Each(dict, COUNT)
_EXPOSURE_TIMING = {
    **dict.fromkeys(("exposures", "untold"), COUNT),
    **dict.fromkeys(("worst_start_us", "worst_length_us", "tolerance_us"), (None, SIGNED)),
}
_CLOCK = {"worst_uncertainty_us+": AMOUNT, "drift_ppm": (None, SIGNED)}
_EXPECTED = (None, {"accuracy": _PART, "clicks": _MEAN, "photons": _MEAN})
D, F, W, R, C = Part.DECISIONS, Part.FLOW, Part.WALKS, Part.RUN, Part.COMMAND

_ROWS = (
    # ---- decisions ----
    Figure("accuracy", "Share of right decisions", D, _PART, unit="share", name="accuracy", form="{:.2%}",
        short="{:.1%}", of="judged", interval=True, shown=Shown.RESULTS | Shown.TREND | Shown.CARD | Shown.EXPORT),
    Figure("accuracy_std_trials", "Standard deviation of the accuracy over trials", D, _PART, unit="share", form="{:.2%}", of="judged"),
    # its square divides: no number whose square is 0
    Figure("accuracy_stderr_objects", "Standard error of the accuracy from having few objects", D, (None, Range(0, 0), Range(1e-70, 1)),
        unit="share", of="judged"),
    Figure("objects", "Distinct objects with a known truth", D, COUNT, of="judged"),
    Figure("trials", "Trials of each object", D, COUNT, of="judged"),
    Figure("decisions", "Decisions made", D, COUNT, name="decisions", word="decisions", form="{:,}", short="{}",
        shown=Shown.RESULTS | Shown.CARD, live="decisions", metric="pans_decisions", counts=True),
    Figure("decided", "Decisions with a label", D, COUNT),
    Figure("judged", "Decisions with a label whose true class is known", D, COUNT, form="{:,}", shown=Shown.CARD),
    Figure("abstained", "Decisions without a label", D, COUNT, form="{:,}", shown=Shown.CARD),
    Figure("clicks_mean", "Clicks per decision", D, _MEAN, unit="clicks per decision", name="clicks per decision", word="clicks",
        form="{:.3f}", short="{:.2f}", of="figures_of",
        shown=Shown.RESULTS | Shown.INDEX | Shown.TREND | Shown.COMPARE | Shown.CARD | Shown.EXPORT, see="../explanation/photons.md"),
    Figure("photons_mean", "Expected photoelectrons per decision", D, _MEAN, unit="photons per decision", name="photons per decision",
        word="photons", form="{:.3f}", short="{:.2f}", of="figures_of", shown=Shown.INDEX | Shown.COMPARE | Shown.CARD | Shown.EXPORT,
        see="../explanation/photons.md"),
    Figure("photons_known", "Decisions whose photons are known: `photons_mean` is of these", D, COUNT, form="{:,}"),
    Figure("figures_of",
        "Of which decisions each figure is: `judged`; `decided` if no true class is known; `decisions`: all; `alone`: of a flow",
        D, Each(dict, str)),
    # ---- objects in flow ----
    Figure("flow", "Settings that the run found or was given; `bars_per_s` is the speed of the tape, as last found", F),
    Figure("accuracy_labelled", "Share of right decisions with a label, about objects alone", F, _PART, unit="share", interval=True),
    Figure("missed", "Share of objects alone without a decision", F, _PART, unit="share", interval=True),
    Figure("doubled", "Share of objects alone with more than one decision", F, _PART, unit="share", interval=True),
    Figure("yield", "Share of targets pulsed, in coincidence or not", F, _PART, unit="share", interval=True),
    Figure("purity", "Share of pulses that met a target alone, of all pulses made", F, _PART, unit="share",
        interval=True),
    Figure("aborted", "Decisions without a label by reason", F, _COUNTS, of="decisions"),
    Figure("passages", "The counts behind the shares; `without_mark` are decisions about nothing", F,
        {"alone+": COUNT, "missed+": COUNT}),
    Figure("passage_clicks_mean", "Clicks of a whole passage, not only of the decided window", F, _MEAN, unit="clicks per decision",
        form="{:.3f}"),
    Figure("passage_photons_mean", "Photons of a whole passage, at least", F, _MEAN, unit="photons per decision", form="{:.3f}"),
    Figure("centre_offset_exposures", "How far the found centre lies from the true one", F, unit="exposures"),
    Figure("gates", "Pulses `asked`, `done`, `refused`, `expired`", F, _COUNTS),
    Figure("second_instrument", "Serial number, drift and worst uncertainty of a pulse of the instrument that pulses", F),
    # ---- automata ----
    Figure("drive", "Who chooses the state: `device` or `host`", W, _TEXT),
    Figure("confidence", "Confidence at which walks were to end; 0: none", W, _PART),
    Figure("exposures_mean", "Exposures of a walk, without those after its leaf", W, _MEAN, unit="exposures", form="{:.3f}",
        of="decisions"),
    Figure("illumination_mean", "Light of the states that were shown, per decision, dwell included; `illumination` is the same", W, _MEAN,
        unit="illumination per decision", form="{:.3f}", short="{:.1f}", of="decisions"),
    Figure("abstained_below_confidence", "Decisions without a label because of `confidence`: these are no fault", W, COUNT),
    Figure("late_slots", "Slots that stayed dark because the host named no state in time", W, COUNT),
    Figure("turn_us",
        "Quantiles of the time from the arrival of a block until the name of the next state had left; `null` unless the host drives", W,
        (None, _QUANTILES), unit="us"),
    Figure("turn_budget_us", "From the end of an exposure to the next one: time of the host and of the link", W, _MEAN, unit="us",
        form="{:.0f} us"),
    Figure("expected", "What the bundle states for its profile, task and split", W, _EXPECTED),
    Figure("expected_off_stderr",
        "Measured less expected accuracy in standard errors over objects, on that profile and without `confidence`", W, (None, SIGNED)),
    # ---- the run ----
    Figure("illumination", "Sum of the intensities of the patterns shown, per decision", R, _MEAN, unit="illumination per decision",
        name="illumination per decision", word="illumination", form="{:.3f}", short="{:.1f}", of="figures_of",
        shown=Shown.RESULTS | Shown.INDEX | Shown.COMPARE | Shown.CARD | Shown.EXPORT, see="../explanation/photons.md"),
    Figure("late", "Decisions later than the deadline", R, COUNT, name="late decisions", word="late", form="{:,}", short="{}",
        of="decisions", total="decisions", rate_unit="per decision",
        shown=Shown.RESULTS | Shown.INDEX | Shown.TREND | Shown.COMPARE | Shown.CARD, live="late", metric="pans_late_decisions",
        counts=True),
    Figure("late_blame", "Late decisions by the stage in which the time was spent", R),
    Figure("late_cause", "Late decisions by cause", R, _COUNTS, live="late_cause", metric="pans_late_decisions_by_cause", counts=True,
        label="cause", more="`link`, `device`, `host`, `gc`, `disk`, `inference`, `decode`", see="../explanation/timing.md"),
    Figure("lost_cause", "Lost exposures by cause", R, live="lost_cause", metric="pans_lost_exposures_by_cause", counts=True,
        label="cause", see="../explanation/timing.md"),
    Figure("blame", "The first causes that the evidence names, each with its evidence", R),
    Figure("lost", "Exposures that never came", R, COUNT, name="lost exposures", form="{:,}", short="{}", total="stream.exposures",
        rate_unit="per exposure", shown=Shown.COMPARE | Shown.CARD, live="lost_exposures", metric="pans_lost_exposures",
        counts=True),
    Figure("latency_us",
        "Quantiles of the time from the end of the last exposure to the decision; quantile q of fewer than 1/(1 - q) decisions is null",
        R, _QUANTILES, unit="us", more="`p50`, `p99` (null below 100 decisions), `p999` (null below 1000), `max`"),
    Figure("stage_latency_us", "The same for the stages `link`, `decode`, `decide` and `record`", R, Each(dict, _QUANTILES), unit="us"),
    Figure("deadline_us", "The deadline of a decision", R, AMOUNT, unit="us", form="{:,.0f} us"),
    Figure("clock", "`drift_ppm`, `uncertainty_us` and `worst_uncertainty_us` of the device's clock", R, _CLOCK),
    Figure("slot_jitter_us", "How far exposures were off their slots, at most", R, AMOUNT, unit="us", form="{:.1f} us"),
    Figure("exposure_timing",
        "When exposures happened, as the device told; null where it told nothing", R, _EXPOSURE_TIMING,
        more="`announced`, `exposures`, `untold` (ended, but EXPOSED did not report them), `worst_start_us`, `worst_length_us`, "
        "`worst_start_exposure` and `worst_length_exposure` (number since ARM), `tolerance_us`, `within`",
        see="protocol.md#15-when-exposures-happened"),
    Figure("wrong_patterns", "Exposures that showed another pattern, late slots among them", R, COUNT),
    Figure("dark", "Clicks without light: `policy`, `clicks`, `exposures`, `expected`, `findings`, `present`, `channels`", R,
        {**_DARK, "alarm": str, "findings": list, "channels": Each(list, _DARK)}, see="../how-to/dark-counts.md"),
    Figure("stream", "Counters of messages and exposures", R, _COUNTS,
        more="`repeated` messages; of these `repeats_differing` are contradictions, `repeats_unchecked` had nothing to compare with"),
    Figure("stream.gaps", "Gaps in the stream", R, live="gaps", metric="pans_gaps", counts=True),
    Figure("stream.exposures", "Exposures received", R, word="exposures", live="exposures", metric="pans_exposures", counts=True),
    Figure("link", "Counters of bytes and frames", R, more="damaged, discarded, of unknown type, of another session"),
    Figure("contradictions", "Messages that make no sense or cannot be true, by what is wrong in them; each fails the run", R,
        see="protocol.md#10-what-the-host-believes"),
    Figure("realtime", "Real-time privileges that were granted", R, dict),
    Figure("page_faults",
        "`minor`, `major`, `involuntary_switches` and `waited_ms` of the loop's thread while armed; empty where the system does not tell",
        R, Each(dict, AMOUNT), see="../how-to/real-time.md#look-at-page-faults"),
    Figure("device", "What the device says of itself", R, {"objects": OBJECTS}),
    Figure("armed_after_s", "From the start to ARM", R, AMOUNT, unit="s", form="{:.2f} s"),
    Figure("seconds", "Length of the measurement", R, AMOUNT, unit="s", form="{:.1f} s"),
    Figure("ended", "Why the run ended", R, _TEXT, shown=Shown.CARD, live="ended",
        more="`completed`, `stopped by SIGTERM`, an error; where the loop was stuck, if the watchdog ended the run"),
    Figure("link_lost", "Whether the device was lost for good", R, bool),
    Figure("reconnects", "Times the device was lost and found again", R, COUNT, live="reconnects", metric="pans_reconnects", counts=True),
    Figure("decisions_sha256", "SHA-256 of the decision log", R, _TEXT),
    Figure("simulated", "Whether the clicks were simulated", R, bool),
    Figure("verdict", "`PASS` or `FAIL`", R, shown=Shown.CARD, live="verdict"),
    Figure("faults", "Why the run failed, one sentence each", R, _TEXTS, shown=Shown.CARD, live="faults"),
    Figure("warnings", "What may have spoilt decisions and is no fault", R, _TEXTS,
        more="a change of the light, a detector that always or never clicks in light"),
    Figure("calibration", "The calibration in use", R),
    Figure("calibration_warnings", "What is wrong with the calibration", R, _TEXTS),
    Figure("light",
        "The watch on the light", R, more="`found`, `found_after_decisions`, `change_of_clicks`, `clicks_stated` by an automaton's "
        "bundle; `states` of an automaton with `first_state_clicked` and `first_state_stated` (least, largest); false alarms: "
        "`false_alarm_every_decisions`, `false_alarm_per_run` at the beginning"),
    Figure("registration", "The registration in use", R,
        more="file, SHA-256, light kept, relative error of the patterns' light before and after the correction"),
    Figure("late_allowed", "Share of the decisions that might be late (`--late-allowed`)", R, _PART, form="{:.3%}"),
    Figure("busy", "Why few late decisions of `pans demo` are no fault: other programs kept the host waiting; else empty", R, _TEXT,
        more="up to 5 % of the decisions, and nothing else is wrong; the exit code is then 0"),
    # ---- within objects of the run ----
    Figure("dark.exposures", "Exposures without light", R, word="dark exposures", live="dark_exposures", metric="pans_dark_exposures",
        counts=True),
    Figure("dark.clicks", "Clicks in exposures without light", R, name="dark clicks per exposure", total="dark.exposures",
        rate_unit="clicks per dark exposure", shown=Shown.COMPARE, compared="dark_rate", live="dark_clicks", metric="pans_dark_clicks",
        counts=True),
    Figure("latency_us.p50", "Exposure end to decision, median of the run", R, unit="us", name="latency p50",
        compared="latency_p50"),
    Figure("latency_us.p99", "Exposure end to decision, 99 % quantile of the run", R, unit="us", name="latency p99", form="{:,.0f} us",
        shown=Shown.TIMED | Shown.CARD, compared="latency_p99", live="latency_p99_us", metric="pans_latency_p99_seconds"),
    Figure("latency_us.p999", "Exposure end to decision, 99.9 % quantile of the run", R, unit="us", name="latency p99.9",
        compared="latency_p99.9"),
    Figure("latency_us.max", "Exposure end to decision, longest of the run", R, unit="us", live="latency_max_us",
        metric="pans_latency_max_seconds"),
    Figure("exposure_timing.worst_start_us", "Farthest start of an exposure off its tick", R, unit="us", name="exposures off the plan",
        form="{:+.3g} us", shown=Shown.RESULTS, live="exposure_start_us", metric="pans_exposure_start_error_seconds"),
    Figure("exposure_timing.worst_length_us", "Farthest length of an exposure off the plan", R, unit="us", form="{:+.3g} us",
        live="exposure_length_us", metric="pans_exposure_length_error_seconds"),
    Figure("dark.per_exposure", "Clicks per exposure without light", R, unit="clicks per dark exposure", name="dark clicks per exposure",
        form="{:.3g}", shown=Shown.RESULTS | Shown.TREND),
    # ---- what the command adds ----
    Figure("recording", "The recording", C, live="recording"),
    Figure("report", "The summary as Markdown", C),
    Figure("shots", "Shots of a decision", C),
    Figure("seed", "Seed of the simulated scene", C),
    # ---- the state file alone ----
    Figure("", "What the run does", None, live="state",
        more="`setting up`, `running`, `device lost`, `stopped`; `stalled`: `loop_age_s` is above 0.75, or above 15 without the device"),
    Figure("", "When the file was written, UTC", None, live="utc"),
    Figure("", "Number of the process", None, live="pid"),
    Figure("", "Verdict of the latest run that ended, as the file before had it; `cut`: none", None, live="last_verdict"),
    Figure("", "Folder of that run", None, live="last_folder"),
    Figure("", "The latest error in words", None, live="last_error"),
    Figure("", "Resident memory", None, unit="bytes", live="rss_bytes", metric="pans_resident_memory_bytes"),
    Figure("", "Open file handles", None, live="handles", metric="pans_open_handles"),
    Figure("", "Threads", None, live="threads", metric="pans_threads"),
    Figure("", "Since the loop turned last", None, unit="s", live="loop_age_s", metric="pans_loop_age_seconds"),
    Figure("", "Since the start of the command", None, unit="s", live="uptime_s", metric="pans_uptime_seconds"),
    Figure("", "Free bytes on the disk of the recording", None, unit="bytes", live="disk_free_bytes", metric="pans_disk_free_bytes"),
    Figure("", "Until that is full at the present rate; +Inf: not known, or never", None, unit="s", live="disk_left_s",
        metric="pans_disk_left_seconds", more="left out of the file while it is not known"),
    Figure("", "Size of the recording, or of its open part", None, unit="bytes", live="recording_bytes", metric="pans_recording_bytes"),
    Figure("", "Times the computer's clock was set during the run", None, live="host_clock_steps", metric="pans_host_clock_steps",
        counts=True),
    Figure("", "Whether the computer's clock is synchronised", None, live="host_clock_synchronised",
        metric="pans_host_clock_synchronised", more="as the kernel says (Linux)"),
    Figure("", "Parts of the recording that were begun", None, live="parts", metric="pans_recording_parts", counts=True),
    Figure("", "1 while the detector in the dark, or the light, is not as it should be", None, live="alarms", metric="pans_alarm",
        label="kind", more="`hot`, `burst`, `drift`, `quiet`, `dead`, and `light`", see="../how-to/dark-counts.md"),
    Figure("", "Dark rate over the expected one at the finding", None, live="times_expected", metric="pans_alarm_times_expected",
        label="kind"),
)  # fmt: skip
FIGURES: dict[str, Figure] = {one.key or one.live: one for one in _ROWS}
