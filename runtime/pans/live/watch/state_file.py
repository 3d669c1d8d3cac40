"""A run as one flat picture: what it has done, what went wrong last, what it uses; and the file that holds it, written each second.

Whether the loop turns is judged by its own stamp: it sets `Status.turned_s` at each iteration, and while it looks for a lost device at
each attempt.
"""

from __future__ import annotations

import os
import stat
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pans.base.errors import DamagedFileError, UsageError
from pans.base.files import canonical_json, parse_json_object, replace_file
from pans.base.numbers import Part, decision_figures, live_figures
from pans.live.journal import words_of

if TYPE_CHECKING:
    from pans.live.accounts import Account
    from pans.live.status import Status
    from pans.record.recorder import Recorder

FORMAT = "pans-state 1"
MAX_BYTES = 1 << 16
# kinds of findings in the dark; light: the clicks of decisions have changed
ALARMS = ("hot", "burst", "drift", "quiet", "dead", "light")
EVERY_S = 1.0
GOODBYE_S = 5.0
OTHER_WRITER_S = 1.0
STALLED_AFTER_S = 0.75  # an iteration waits 20 ms at most; the file, written each second, says "stalled" within 2 s
LOST_STALLED_AFTER_S = 15.0  # while a lost device is looked for: pauses of 2 s, a handshake of 5 s, the upload


def loop_age_s(run: Status) -> float:
    """Return how long ago the loop turned, in seconds."""
    return max(0.0, time.monotonic() - run.turned_s)


def is_stalled(run: Status) -> bool:
    """Whether the loop should have turned by now."""
    return loop_age_s(run) > (STALLED_AFTER_S if run.outage_ns is None else LOST_STALLED_AFTER_S)


def read_state(path: Path) -> dict[str, Any] | None:
    """Return what the state file at `path` says; None where there is none, or another file."""
    try:
        found = parse_json_object(path.read_bytes(), str(path)) if path.stat().st_size <= MAX_BYTES else {}
    except (OSError, DamagedFileError):  # strict: what is no JSON, such as Infinity, could not be written again
        return None
    return found if found.get("format") == FORMAT else None


def alarms_of(run: Status) -> dict[str, dict[str, Any]]:
    """Return `alarms`, for each of ALARMS whether it lasts, 1 or 0, and `times_expected`, the dark rate over the expected one of each kind.

    A change of the light lasts to the end of the run. A rate is that at the finding, of several channels the highest.
    """
    guard = run.core.guard
    found = [] if guard is None else guard.serious
    alarms = dict.fromkeys(ALARMS, 0) | {one.kind: 1 for one in found}
    times = sorted((one.rate / one.expected, one.kind) for one in found if one.expected > 0)
    alarms["light"] = int(run.accounts.journal.counts["light_changed"] > 0)
    return {"alarms": alarms, "times_expected": {kind: ratio for ratio, kind in times}}


def picture_of(run: Status | None, recorder: Recorder | None, started_s: float) -> dict[str, Any]:
    """Return the run's figures as they are now, JSON-able, units in the keys; `started_s` is on time.monotonic's scale."""
    picture: dict[str, Any] = {
        "format": FORMAT,
        "utc": datetime.now(UTC).isoformat(timespec="milliseconds"),
        "state": "setting up",
        "pid": os.getpid(),
        "uptime_s": round(time.monotonic() - started_s, 3),
        **resources_used(),
    }
    if recorder is not None:
        picture["recording"] = str(recorder.open_file.path)
        picture |= {"parts": recorder.parts} if recorder.parts else {}
    if run is None:
        return picture
    told, account = run.core.exposed, run.accounts.account()
    exposed = {"exposure_start_us": told.start_error, "exposure_length_us": told.length_error} if told.exposures else {}
    trouble = account.trouble
    return picture | {
        "state": state_of(run),
        "loop_age_s": round(loop_age_s(run), 3),
        "ended": run.ended,
        # of those that are recorded only what is in the file: the rest is lost if the process is killed
        "decisions": run.core.n_decisions if recorder is None else recorder.n_written,
        "late": account.late,
        "late_cause": account.late_cause,
        "lost_exposures": account.stream["lost_exposures"],
        "lost_cause": account.lost_cause,
        "gaps": account.stream["gaps"],
        "exposures": account.stream["exposures"],
        "latency_p99_us": account.latency_us["p99"],  # None of too few decisions
        "latency_max_us": account.latency_us["max"] or 0.0,
        "dark_exposures": account.dark_exposures,
        "dark_clicks": account.dark_clicks,
        **{key: ticks * run.job.plan.tick_us for key, ticks in exposed.items()},
        "reconnects": run.reconnects,
        **_of_decisions(account),
        **alarms_of(run),
        "last_error": f"{trouble['kind']}: {words_of(trouble)}" if trouble else "",
    }


def _of_decisions(account: Account) -> dict[str, Any]:
    """Return those figures of the state file that follow from the decisions alone, as in the summary."""
    # not `decisions`: of a recording those that are in the file count
    wanted = [one for one in live_figures() if one.part is Part.DECISIONS and one.key != "decisions"]
    found = decision_figures(account.decided) if wanted else None
    return {one.live: getattr(found, one.key) for one in wanted}


def state_of(run: Status) -> str:
    """Return what the run does, in one or two words."""
    if run.ended:
        return "stopped"
    if is_stalled(run):
        return "stalled"
    return "running" if run.outage_ns is None else "device lost"


def resources_used() -> dict[str, int]:
    """Return resident memory in bytes, open handles and threads of this process; 0 where that is not known."""
    rss = handles = 0
    with suppress(OSError, ValueError, IndexError):
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        rss = pages * os.sysconf("SC_PAGE_SIZE")
    with suppress(OSError):
        handles = len(os.listdir("/proc/self/fd")) - 1  # the one that lists them
    return {"rss_bytes": rss, "handles": handles, "threads": threading.active_count()}


class StateFile:
    """Writes what `look` returns to `path`, now, once per second and at the end; `trouble` says why that failed last."""

    def __init__(self, path: Path, look: Callable[[], dict[str, Any]]) -> None:
        self.trouble = ""
        self._path, self._look, self._alone = path, look, threading.Lock()
        self._left: dict[str, Any] = {}
        self._write()
        self._thread = Repeated("pans-state", EVERY_S, self._write)

    def close(self) -> None:
        """Write once more and stop; a file that cannot be written goes: it would say for ever that the run is running."""
        self._thread.close(GOODBYE_S)
        self.trouble = ""
        self._write()
        if self.trouble:
            with suppress(OSError):
                self._path.unlink()

    def leave(self, facts: dict[str, Any]) -> None:
        """Write once more, with `facts` in place of what the run says of itself; they stay."""
        self._left = facts
        self._write()

    def _write(self) -> None:
        if not self._alone.acquire(timeout=OTHER_WRITER_S):
            return  # the other thread hangs in the file system
        data = b""
        try:
            data = canonical_json(self._look() | self._left) + b"\n"
            replace_file(self._path, data)
        except UsageError as error:  # a run does not end because nobody can watch it
            if not self._overwrite(data):
                self.trouble = error.message
        finally:
            self._alone.release()

    def _overwrite(self, data: bytes) -> bool:
        """Write in place of the bytes before: on a full disk these are the only room. Return whether that was possible."""
        with suppress(OSError), open(self._path, "r+b") as file:
            size = os.fstat(file.fileno()).st_size
            if data and stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                file.write(data.rstrip().ljust(size - 1) + b"\n")  # one write; spaces at the end are no part of JSON
                file.flush()
                return True
        return False


class Repeated:
    """Makes `call` every `every_s` seconds, the first time after as long, until `close`."""

    def __init__(self, name: str, every_s: float, call: Callable[[], object]) -> None:
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._keep, args=(every_s, call), name=name, daemon=True)
        self._thread.start()

    def _keep(self, every_s: float, call: Callable[[], object]) -> None:
        while not self._ending.wait(every_s):
            call()

    def close(self, patience_s: float | None = None) -> None:
        """Call no more, and wait for a call under way, at most `patience_s`."""
        self._ending.set()
        self._thread.join(patience_s)
