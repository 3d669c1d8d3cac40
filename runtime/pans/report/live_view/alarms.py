"""A `History` in, picture by picture; the alarms of the run out, each with its beginning, end and cause, and notes as marks."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from pans.base.console import one_line

from .figures import dark_state, rows_of
from .history import History

KEPT = 200
QUIET_S = 10.0  # without another late decision, lost exposure or contradiction: the alarm is over
LASTING = ("state", "dark counts", "exposures", "disk")  # figures that are bad as long as they are
GROWING = {  # sums: their keys, what they count, and the kind of trouble that says why
    "late": ("late", "decisions", "blame"),
    "lost": ("lost_exposures", "exposures", "blame"),
    "contradictions": ("contradictions", "messages", "contradiction"),
}
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
    """What was wrong, in seconds of the run; `end_s` is None while it is, and `noticed_s` of what has no length.

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
        self._counted, self._before = dict.fromkeys(GROWING, 0), dict.fromkeys(GROWING, 0)
        self._trouble = ""
        self._grew_s, self._why = dict.fromkeys(GROWING, -QUIET_S), dict.fromkeys(GROWING, "")

    def take(self, history: History) -> None:
        """Compare the latest picture with what was wrong before."""
        picture, now_s = history.picture, float(history.picture["elapsed_s"])
        for kind, words, since in picture.get("events", ()):
            begin_s = now_s if since is None else history.when("decisions", since)
            self.all.append(Alarm(*INSTANT[kind], begin_s, now_s, one_line(words, 300), now_s))
        present = {} if picture["ended"] else self._present(history, now_s)
        for name in self._open.keys() - present:
            if name in GROWING or not picture["ended"]:  # what lasted when the run ended has no end
                self._open.pop(name).end_s = min(now_s, self._grew_s.get(name, now_s))
        for name, (level, cause, begin_s) in present.items():
            if name not in self._open:
                self._open[name] = Alarm(name, level, begin_s, None, cause, now_s)
                self.all.append(self._open[name])
            self._open[name].cause = cause

    def _present(self, history: History, now_s: float) -> dict[str, tuple[str, str, float]]:
        """Return level, cause and beginning of what is wrong now."""
        picture, rows = history.picture, {row.name: row for row in rows_of(history)}
        lasting = (rows[name] for name in LASTING if name in rows)
        present = {name: (level, text, now_s) for name, text, level in lasting if level in ("warn", "bad")}
        if "dark counts" in present:
            since = min(since for *_, since in picture["dark_states"])
            _, words, level = dark_state(picture)
            present["dark counts"] = level, words, history.when("dark_exposures", since)
        news = "" if picture["last_error"] == self._trouble else picture["last_error"]
        self._trouble = picture["last_error"]
        trouble, _, why = news.partition(": ")
        for name, (key, what, kind) in GROWING.items():
            before, self._counted[name] = self._counted[name], picture[key]
            if picture[key] > before:
                if name not in self._open:
                    self._before[name], self._why[name] = before, ""
                self._grew_s[name] = now_s
            if trouble == kind:
                self._why[name] = f"; {one_line(why, 300)}"
            if now_s - self._grew_s[name] < QUIET_S:
                present[name] = "bad", f"{picture[key] - self._before[name]:,} {what}{self._why[name]}", now_s
        return present
