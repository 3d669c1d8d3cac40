"""One side of a comparison: a run as it was recorded, or as its summary tells.

A path stands for a folder of a run (its recording, or the parts of it), a recording, or the JSON object that `pans run --json` printed. A
summary alone has no decisions: its figures are compared, but not object by object.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

import numpy as np
from numpy.typing import NDArray

from pans.runtime.container import parse_json_object, read_file
from pans.runtime.errors import UsageError
from pans.runtime.record import Recording, read_recording
from pans.runtime.record.parts import find_parts

SUMMARY_MAX_BYTES = 1 << 24
RECORDING = "run.pansrec"


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """A run: where it was found, header and summary as they were written, decisions and latencies (None of a summary alone)."""

    path: Path
    header: Mapping[str, Any]
    summary: Mapping[str, Any]
    decisions: NDArray[np.void] | None
    latency_us: NDArray[np.float64] | None  # exposure end to decision, in the order of time
    complete: bool
    recordings: tuple[Recording, ...] = ()

    @property
    def simulated(self) -> bool:
        """Whether the clicks are simulated."""
        return bool(self.header.get("simulated") or self.summary.get("simulated"))

    @property
    def scene(self) -> str:
        """The scene that a simulated instrument was given, "" where none is named."""
        query = str(self.header.get("device_url", "")).partition("?")[2]
        return (parse_qs(query).get("scene") or [""])[0]


def read_side(path: str | Path) -> Side:
    """Return the run at `path`; UsageError where there is none, DamagedFileError for a damaged file."""
    place = Path(path)
    if place.suffix == ".json" and place.is_file():
        return _of_summary(place)
    files = _recordings(place)
    found = [read_recording(one, salvage=True) for one in files]
    last = found[-1]
    timings = np.concatenate([one.timings() for one in found])
    latency = (timings["decided_ns"] - timings["device_end_ns"]).astype(np.float64) / 1000
    decisions = np.concatenate([one.decisions() for one in found])
    complete = all(one.complete for one in found)
    return Side(place, found[0].header, last.summary, decisions, latency, complete, tuple(found))


def _recordings(place: Path) -> list[Path]:
    if place.is_dir():
        if (place / RECORDING).is_file():
            return [place / RECORDING]
        whole = sorted(place.glob("*.pansrec"))
        parts = find_parts(place)
        if parts:
            return list(parts)
        if len(whole) == 1:
            return whole
        raise UsageError(
            f"{place}: {len(whole)} recordings in this folder, expected one run", remedy="name the recording itself"
        )
    if not place.is_file() and (parts := find_parts(place)):
        return parts
    if not place.is_file():
        raise UsageError(f"{place}: no such file or folder", remedy="name a run's folder, a recording or a summary")
    return [place]


def _of_summary(place: Path) -> Side:
    summary = parse_json_object(read_file(place, SUMMARY_MAX_BYTES), str(place))
    if "decisions" not in summary or "verdict" not in summary:
        raise UsageError(
            f"{place}: not a summary: it has no keys `decisions` and `verdict`",
            remedy="save what `pans run --json` prints, or name the recording",
        )
    return Side(place, {}, summary, None, None, True)
