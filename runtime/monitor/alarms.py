"""A `History` in, picture by picture; the alarms of the run out, each with its beginning, end and cause, and notes as marks."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

from pans.runtime.safe_text import one_line

from .figures import rows_of
from .history import History

KEPT = 200
QUIET_S = 10.0  # without another late decision, lost exposure or contradiction: the alarm is over
LASTING = ("state", "dark counts", "exposures", "disk")  # figures that are bad as long as they are
GROWING = {"late": "late", "lost": "lost", "contradictions": "contradictions", "repeats": "repeats_differing"}
# kinds of events without an end that is known: name, level
INSTANT = {
    "note": ("note", "note"),
    "light_changed": ("light", "warn"),
    "clock_step": ("clock", "warn"),
    "host_clock_step": ("clock", "note"),
    "show_refused": ("refused", "warn"),
    "gate_refused": ("refused", "warn"),
    "parts_trouble": ("disk", "warn"),
}


@dataclass(slots=True)
class Alarm:
    """What was wrong, in seconds of the run; `end_s` is None while it is, and `begin_s` of what has no length.

    What is found in counts began before it was noticed: there `begin_s` is the beginning of the data that it was found in.
    """

    name: str
    level: str  # note, warn or bad
    begin_s: float
    end_s: float | None
    cause: str
    noticed_s: float


class Alarms:
    """The last KEPT alarms of a run, the oldest first, in `all`."""

    def __init__(self) -> None:
        self.all: deque[Alarm] = deque(maxlen=KEPT)
        self._open: dict[str, Alarm] = {}
        self._counted: dict[str, int] = {}
        self._grew_s: dict[str, float] = {}

    def take(self, history: History) -> None:
        """Compare the latest picture with what was wrong before."""
        picture = history.picture
        now_s = float(picture["elapsed_s"])
        for kind, words, since in picture.get("events", ()):
            begin_s = now_s if since is None else history.when("decisions", since)
            self._add(Alarm(*INSTANT[kind], begin_s, now_s, one_line(words, 300), now_s))
        present = self._present(history, now_s)
        for name in [name for name in self._open if name not in present or picture["ended"]]:
            self._open.pop(name).end_s = min(now_s, self._grew_s.get(name, now_s))
        for name, (level, cause) in {} if picture["ended"] else present.items():
            if name not in self._open:
                begin_s = now_s
                if name == "dark counts" and picture.get("dark_states"):
                    begin_s = history.when("dark_exposures", min(since for *_, since in picture["dark_states"]))
                self._open[name] = self._add(Alarm(name, level, begin_s, None, cause, now_s))
            self._open[name].cause = cause

    def _add(self, alarm: Alarm) -> Alarm:
        self.all.append(alarm)
        return alarm

    def _present(self, history: History, now_s: float) -> dict[str, tuple[str, str]]:
        """Return level and cause of what is wrong now."""
        picture: dict[str, Any] = history.picture
        rows = {row.name: row for row in rows_of(history)}
        found = {name: (rows[name].level, rows[name].text) for name in LASTING if name in rows}
        present = {name: one for name, one in found.items() if one[0] in ("warn", "bad")}
        for name, key in GROWING.items():
            if (count := picture.get(key, 0)) > self._counted.get(name, 0):
                self._grew_s[name] = now_s
            self._counted[name] = count
            if now_s - self._grew_s.get(name, -QUIET_S) < QUIET_S and name in rows:
                why = f"; {one_line(picture['trouble'], 200)}" if picture["trouble"] else ""
                present[name] = ("bad", f"{rows[name].text} in the whole run{why}")
        return present
