"""A recording as tables: one list of columns, with units and meanings, behind CSV, Parquet, pandas and xarray.

A column is an array, masked where a value is missing. Times of day come from the host's clock: differences between rows are exact, the
beginning is known to about two seconds.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from datetime import datetime
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.base.console import needed
from pans.base.errors import DamagedFileError, UsageError
from pans.base.numbers import Shown, shown
from pans.bundle.backends import NO_LABEL
from pans.decide import DecisionFlag
from pans.decide.plan import Plan
from pans.decide.still import visit_maps
from pans.protocol.wire import NO_OBJECT
from pans.record.reading.exposures import ClickList, click_list, first_tick, is_dark
from pans.record.reading.format import TIMING_DTYPE
from pans.record.reading.parts import earlier_parts, first_decision, part_of
from pans.record.reading.recording import Recording, together
from pans.record.reading.sent_plan import SHOTS, recorded_plan

Table = Mapping[str, NDArray[Any]]


class Column(NamedTuple):
    """What stands in one column; `missing` says what an empty cell, null or NaN means, "" where every row has a value."""

    dtype: str  # of NumPy, "str" for texts
    unit: str  # "" where there is none
    meaning: str
    missing: str = ""


SINCE = "since the begin of the first recorded exposure"
DECISIONS = {
    "decision": Column("int64", "", "number of the decision in its run, from 0"),
    "tick": Column("int64", "tick", "end of the last exposure, on the device's clock"),
    "time_us": Column("float64", "us", f"end of the last exposure, {SINCE}, on the device's clock"),
    "exposure": Column("int64", "", "number of the last exposure in its stream"),
    "object": Column("int64", "", "number of the object"),
    "first_shot": Column("int64", "", "first shot of the decision within the object's visit"),
    "clicks": Column("int64", "", "clicks counted for the decision; photons of a detector that counts them"),
    "label": Column("int32", "", "class that was decided", "no class was decided"),
    "class": Column("str", "", "name of that class", "no class was decided, or it has no name"),
    "truth": Column("int32", "", "true class, as the device marked it", "unknown"),
    "probability": Column("float32", "1", "softmax of the class that was decided", "no class was decided"),
    "flags": Column("int32", "", "sum of the flags; 0: none"),
    "flag_names": Column("str", "", "names of the flags, joined by |"),
    "exposures": Column(
        "int64", "", "lit exposures of the automaton's walk", "fixed patterns: the same for every decision"
    ),
}
TIMINGS = {
    "decision": DECISIONS["decision"],
    "device_end_ns": Column("int64", "ns", "end of the last exposure, on the host's monotonic clock", "not recorded"),
    "arrival_ns": Column("int64", "ns", "last bytes read, on the same clock", "not recorded"),
    "decided_ns": Column("int64", "ns", "decision made, on the same clock", "not recorded"),
    "recorded_ns": Column("int64", "ns", "decision handed to the recorder, on the same clock", "not recorded"),
    "latency_us": Column(
        "float64",
        "us",
        "from the end of the last exposure to the decision",
        "not recorded, or not measured: virtual time",
    ),
}
CLICKS = {
    "exposure_start_tick": Column("int64", "tick", "begin of the exposure that clicked, on the device's clock"),
    "exposure_start_us": Column("float64", "us", f"begin of the exposure that clicked, {SINCE}, on the device's clock"),
    "exposure": Column("int64", "", "number of the exposure in its stream"),
    "object": Column("int64", "", "number of the object", "not known: objects pass by"),
    "channel": Column("int64", "", "channel of the detector"),
    "pattern": Column("int64", "", "pattern displayed", "no light"),
    "dark_slot": Column("int64", "", "1 in an exposure without light"),
    "stream": Column("int64", "", "0 until the device was lost and found again, then 1, ...; of what is read"),
    "state": Column("int64", "", "state of the automaton", "fixed patterns, or no light"),
    "photons": Column("int64", "", "photons counted", "the detector tells a click, not how many photons"),
    "decision": Column("int64", "", "decision it was counted for", "none: in the dark, cut off, or objects pass by"),
}


def tick_us(recording: Recording) -> float:
    """Return the length of a device tick in us."""
    return 1e6 / int(recording.header["config"]["tick_hz"])


def facts_of(recording: Recording) -> dict[str, Any]:
    """Return what stands beside a table: where it is from, whether its clicks are simulated, and figures of the run.

    A figure is None where the recording was cut, or does not know it.
    """
    return {
        "recording": recording.path.name,
        "simulated": recording.simulated,
        "complete": recording.complete,
        "first_decision": first_decision(recording),
        "earlier_parts": earlier_parts(recording),
        "tick_us": tick_us(recording),
        "classes": list(recording.bundle().classes if recording.bundle_place else ()),
        "decisions_sha256": recording.decisions_sha256,
        "bundle_sha256": recording.header.get("bundle_sha256"),
        "figures": {one.key: one.value(recording.summary) for one in shown(Shown.EXPORT)},
    }


def iter_decisions(
    recording: Recording, plan: Plan, blocks: Iterable[NDArray[np.void]] | None = None
) -> Iterator[Table]:
    """Yield the decisions, columns of DECISIONS, block by block; `blocks` are DECISION_DTYPE (n,), by default those of the file."""
    names = np.array([*(recording.bundle().classes if recording.bundle_place else ()), ""], object)
    zero, us = first_tick(recording, plan), tick_us(recording)
    for rows in recording.iter_decisions() if blocks is None else blocks:
        label = rows["label"].astype(np.int32)
        undecided, nameless = rows["label"] == NO_LABEL, label >= len(names) - 1
        flags, place = np.unique(rows["flags"], return_inverse=True)
        words = ["|".join(str(flag.name) for flag in DecisionFlag(int(value))) for value in flags]
        found = {
            "decision": rows["index"],
            "tick": rows["tick"],
            "time_us": np.round((rows["tick"].astype(np.int64) - zero) * us, 3),
            "exposure": rows["exposure_index"],
            "object": rows["object"],
            "first_shot": rows["shot"],
            "clicks": rows["clicks"],
            "label": np.ma.array(label, mask=undecided),
            "class": np.ma.array(names[np.where(nameless, -1, label)], mask=nameless),
            "truth": np.ma.array(rows["truth"], mask=rows["truth"] < 0),
            "probability": np.ma.array(rows["probability"], mask=undecided),
            "flags": rows["flags"],
            "flag_names": np.array(words, object)[place],
            "exposures": np.ma.array(rows["exposures"], mask=rows["exposures"] == 0),
        }
        yield _typed(found, DECISIONS)


def timing_table(rows: NDArray[np.void], *, virtual: bool) -> Table:
    """Return the host times, TIMING_DTYPE (n,), as columns of TIMINGS; in `virtual` time nothing took any, and there is no latency."""
    found = {"decision": rows["index"], **{name: rows[name] for name in TIMING_DTYPE.names or () if name != "index"}}
    latency_us = np.round((rows["decided_ns"] - rows["device_end_ns"]) / 1000, 3)
    found["latency_us"] = np.ma.array(latency_us, mask=np.full(len(rows), virtual))
    return _typed(found, TIMINGS)


def click_table(recording: Recording, plan: Plan, clicks: ClickList) -> Table:
    """Return the clicks as columns of CLICKS."""
    dark = is_dark(clicks.pattern)
    counts = plan.largest > 1 and plan.channels_at_once == 1
    found = {
        "exposure_start_tick": clicks.start_tick,
        "exposure_start_us": np.round((clicks.start_tick - clicks.first_tick) * tick_us(recording), 3),
        "exposure": clicks.exposure,
        "object": np.ma.array(clicks.object, mask=clicks.object == NO_OBJECT),
        "channel": clicks.channel,
        "pattern": np.ma.array(clicks.pattern, mask=dark),
        "dark_slot": dark,
        "stream": clicks.stream,
        "state": np.ma.array(clicks.state, mask=dark | (plan.automaton is None)),
        "photons": np.ma.array(clicks.photons, mask=np.full(len(dark), not counts)),
        "decision": _decisions_of(recording, plan, clicks),
    }
    return _typed(found, CLICKS)


def _decisions_of(recording: Recording, plan: Plan, clicks: ClickList) -> NDArray[np.int64]:
    """Return the number of the decision that each click was counted for, masked where there is none.

    A stream decides on all windows up to its end in order. So visit and window give the number of a decision within its stream.
    """
    config = recording.header["config"]
    if "flow" in config:
        return np.ma.array(clicks.exposure, mask=np.full(len(clicks.exposure), True))
    try:
        shots = SHOTS.checked(config["shots"], "shots")
    except (KeyError, ValueError) as error:
        raise DamagedFileError(f"{recording.path}: its header has no config.shots that can be: {error}") from error
    _, window_at = visit_maps(plan, shots)
    per_visit, visit = plan.shots_per_cycle * plan.cycles_per_object // shots, len(window_at)
    fields, nobody = ("index", "exposure_index", "shot"), np.full((1, 3), -1)
    blocks = together(recording.iter_decisions())
    made = [np.column_stack([rows[name].astype(np.int64) for name in fields]) for rows in blocks]
    index, last, shot = np.concatenate([*made, nobody]).T
    number = last // visit * per_visit + shot // shots
    # The number that the first decision of the same stream has in the run. It alone tells streams apart: a device that was reset counts
    # ticks from 0 again.
    begin = index - number
    begins, streams = np.unique(begin[:-1]), clicks.lit_streams
    if number[0] > 0:  # a later part, which may hold decisions of its first stream and no exposure
        streams = np.union1d(streams, [0])
    known = min(len(begins), len(streams))  # a file that was cut off may lack decisions
    begin_of = np.full(max(clicks.stream.max(initial=0), streams.max(initial=0)) + 1, -1)
    begin_of[streams[:known]] = begins[:known]
    own = begin_of[clicks.stream]
    wanted = own + clicks.exposure // visit * per_visit + window_at[clicks.exposure % visit]
    at = np.searchsorted(index[:-1], wanted)
    found = (own >= 0) & (index[at] == wanted) & (begin[at] == own)
    return np.ma.array(index[at], mask=~found | is_dark(clicks.pattern))


def to_frame(recording: Recording, table: str = "decisions") -> Any:
    """Return the `decisions` with their host times, or the `clicks`, as a pandas.DataFrame; needs the extra `frames`.

    The index `time` is the time of day in UTC: exact between rows, its beginning known to about two seconds. Columns are those of
    the CSV export; `attrs` has their `units` and `meanings` and the recording's facts. A missing value is NA or NaN. The column
    `flags` is `frame["flags"]`, because pandas has an attribute of that name.

    `to_frame(recording).latency_us.resample("1min").quantile(0.99)` is the latency over time.
    """
    pandas = needed("pandas", "to_frame", "frames")
    columns, data, times = _timed(recording, table)
    found = {}
    for name, values in data.items():
        kind = columns[name].dtype
        if columns[name].missing and kind.startswith("int"):
            found[name] = pandas.arrays.IntegerArray(np.ma.getdata(values), np.ma.getmaskarray(values))
        else:
            found[name] = np.ma.filled(values, np.nan if kind.startswith("float") else None)
    frame = pandas.DataFrame(found, index=pandas.DatetimeIndex(times, tz="UTC", name="time"))
    frame.attrs = facts_of(recording)
    frame.attrs["units"] = {name: column.unit for name, column in columns.items() if column.unit}
    frame.attrs["meanings"] = {name: column.meaning for name, column in columns.items()}
    return frame


def to_xarray(recording: Recording, table: str = "decisions") -> Any:
    """Return a table of `to_frame` as an xarray.Dataset along `time`; needs the extra `frames`.

    Each variable has `units` and `long_name`, and says what stands for a missing value: -1, NaN or an empty text.
    """
    xarray = needed("xarray", "to_xarray", "frames")
    columns, data, times = _timed(recording, table)
    found = {}
    for name, values in data.items():
        _, unit, meaning, missing = column = columns[name]
        empty: Any = {"s": "", "f": np.nan}.get(column.dtype[0], -1)
        filled = np.ma.filled(values, empty)
        said = {"long_name": meaning, "units": unit, "missing": f"{empty!r}: {missing}" if missing else ""}
        filled = filled.astype(str) if column.dtype == "str" else filled
        found[name] = ("time", filled, {key: value for key, value in said.items() if value})
    facts = facts_of(recording)
    facts |= {key: np.nan if value is None else value for key, value in facts.pop("figures").items()}
    about = {key: int(value) if isinstance(value, bool) else value or "" for key, value in facts.items()}
    return xarray.Dataset(found, {"time": ("time", times, {"long_name": "UTC"})}, about)


def _timed(recording: Recording, table: str) -> tuple[Mapping[str, Column], Table, NDArray[np.datetime64]]:
    """Return the columns of `table`, their arrays, and the time of day of each row."""
    plan = recorded_plan(recording)
    timings = recording.timings()
    if table == "clicks":
        clicks = click_list(recording, plan)
        if (np.diff(clicks.start_tick) < 0).any():
            raise UsageError(
                f"{recording.path}: the device's clock went back (it was switched off in between): clicks have no time of day",
                remedy="pans export FILE --format csv, which numbers the streams",
            )
        first = recording.decisions()[:1]
        tick_ns = tick_us(recording) * 1000
        # the host's time of one tick, which the first decision tells
        host, tick = (timings["device_end_ns"][0], first["tick"][0]) if len(timings) and len(first) else (0, 0)
        since = np.round((clicks.start_tick - np.int64(tick)) * tick_ns).astype(np.int64)
        return CLICKS, click_table(recording, plan, clicks), _times(recording, host + since)
    if table != "decisions":
        raise UsageError(f"table {table!r}: unknown", remedy="decisions or clicks")
    (decided,) = iter_decisions(recording, plan, [recording.decisions()])
    found = dict(decided)
    # a cut file may lack the times of its last decisions, and an outage those of one: they get a row that no decision has
    padded = np.append(timings, np.array([(2**64 - 1, 0, 0, 0, 0)], TIMING_DTYPE))
    rows = padded[np.searchsorted(timings["index"], found["decision"])]
    missing = rows["index"] != found["decision"]
    for name, values in timing_table(rows, virtual=recording.virtual_time).items():
        if name != "decision":
            found[name] = np.ma.array(values, mask=missing | np.ma.getmaskarray(values))
    times = _times(recording, rows["device_end_ns"])
    times[missing] = np.datetime64("NaT")
    return DECISIONS | TIMINGS, found, times


def _times(recording: Recording, host_ns: NDArray[np.int64]) -> NDArray[np.datetime64]:
    """Return times of day (UTC) of times on the host's monotonic clock: its first command left when the recording was begun."""
    part = part_of(recording)
    text = str(recording.header.get("created_utc") if part is None else part.get("utc"))
    try:
        begun = np.datetime64(datetime.fromisoformat(text).replace(tzinfo=None), "ns")
    except ValueError as error:
        raise DamagedFileError(f"{recording.path}: begun at {ascii(text)[:40]}, which is no date") from error
    first_ns, _ = next(recording.commands(), (0, b""))
    return begun + (host_ns - first_ns).astype("timedelta64[ns]")


def _typed(found: Table, columns: Mapping[str, Column]) -> Table:
    return {name: found[name].astype(object if c.dtype == "str" else c.dtype) for name, c in columns.items()}
