"""`PansDetector`: a run as an ophyd-async device for the plans of bluesky. Needs the extra `ophyd`.

`stage` opens the device and arms it, each `trigger` waits for one decision, `unstage` stops the device and closes the recording. The run is
what `pans run` does, in a thread of its own; it does not wait for a plan.
"""

from __future__ import annotations

import asyncio
import threading
from pathlib import Path
from typing import Any

import numpy as np

from pans.app.run import Outcome, profile_of, run_once
from pans.base.console import install
from pans.base.errors import LinkError, PansError, UsageError
from pans.bundle.backends import NO_LABEL
from pans.bundle.sensor import bundle_path, load_bundle
from pans.live.loop import Observers, Session, Status
from pans.live.options import RunOptions
from pans.live.stop import Stop

from .decide import Output, rows_of

try:
    from bluesky.protocols import Triggerable
    from ophyd_async.core import AsyncStatus, StandardReadable, StandardReadableFormat, soft_signal_r_and_setter
except ImportError as error:
    raise ImportError(f"pans.ophyd needs {error.name}: {install('ophyd')}", name=error.name) from error

CONFIGURATION = {"bundle": (str, None), "device": (str, None), "simulated": (bool, None), "tick_hz": (int, "Hz")}
HINTED = {
    "label": (int, None),  # -1: abstained
    "probability": (float, None),  # posterior of the class
    "clicks": (int, "clicks"),
}
READINGS = {
    "class_name": (str, None),  # "": abstained
    "photons": (float, "photoelectrons"),  # expected on this object; nan: the instrument does not know
    "late": (bool, None),
    "abstained": (bool, None),
    "flags": (int, None),  # pans.decide.decision.DecisionFlag
    "number": (int, None),  # of the decision in the run's recording
    "tick": (int, "ticks"),  # of the device, end of the last exposure
}


class PansDetector(StandardReadable, Triggerable):
    """Decisions of `bundle` (a name or .pans) on the device behind a URL, one for each trigger; shapes are (), units as above.

    An event's exposures all began after its trigger, for objects that stand still. `out` is a folder for the recording (None: none),
    `options` are fields of `RunOptions`. After `unstage`, `outcome` is what `pans.run` returns. A trigger raises LinkError when the run has
    ended by itself, stage and unstage raise what ended it (PansError).
    """

    outcome: Outcome | None = None
    _thread: threading.Thread | None = None

    def __init__(
        self, bundle: str | Path, device: str, *, out: str | Path | None = None, name: str = "", **options: Any
    ) -> None:
        path, folder = bundle_path(bundle), None if out is None else Path(out)
        chosen: dict[str, Any] = {"realtime": False, "display": False, "command": "pans.ophyd"} | options
        chosen["profile"] = options.get("profile") or profile_of(device)
        self._options = RunOptions(bundle=path, device=device, out=folder, **chosen)
        self._classes = load_bundle(path)[0].classes
        self._set: dict[str, Any] = {}
        way = StandardReadableFormat
        for kind, fields in ((way.CONFIG_SIGNAL, CONFIGURATION), (way.HINTED_SIGNAL, HINTED), (way.CHILD, READINGS)):
            with self.add_children_as_readables(kind):
                for field, (datatype, units) in fields.items():
                    signal, self._set[field] = soft_signal_r_and_setter(datatype, units=units)
                    setattr(self, field, signal)
        super().__init__(name=name)

    @AsyncStatus.wrap
    async def stage(self) -> None:
        """Begin the run; done when the device is about to be armed."""
        await super().stage()
        self._loop, self._stop = asyncio.get_running_loop(), Stop(continuous=True)
        self._ready, self._ended = self._loop.create_future(), self._loop.create_future()
        self._asked: tuple[int, asyncio.Future[dict[str, Any]]] | None = None
        self._session: Session | None = None
        self._last_tick = 0  # of the latest decision
        self._thread = threading.Thread(target=self._work, name="pans-run", daemon=True)
        self._thread.start()
        self._run: Status = await self._first(self._ready)
        clock, options = self._run.session.known_clock(), self._options
        facts = {"bundle": options.bundle.stem, "device": options.device, "tick_hz": clock.tick_hz}
        self._show(facts | {"simulated": self._run.session.link.simulated})

    @AsyncStatus.wrap
    async def trigger(self) -> None:
        """Wait for the first decision whose exposures begin from now on."""
        if self._thread is None:
            raise UsageError(f"{self.name} is not staged", remedy="use it in a plan that stages, or `bps.stage` first")
        answer = self._loop.create_future()
        self._asked = self._run.now_ns(), answer
        self._show(await self._first(answer))

    @AsyncStatus.wrap
    async def unstage(self) -> None:
        """Stop the device and wait until the recording is closed."""
        await super().unstage()
        if self._thread is not None:
            self._stop.request("unstaged")
            failed, self._thread = await self._ended, None
            if self.outcome is None:
                raise failed

    async def _first(self, answer: asyncio.Future[Any]) -> Any:
        """Return what `answer` is given; raise why the run has ended where that comes first."""
        await asyncio.wait({answer, self._ended}, return_when=asyncio.FIRST_COMPLETED)
        if answer.done():
            return answer.result()
        raise self._ended.result()

    def _show(self, facts: dict[str, Any]) -> None:
        for field, value in facts.items():
            self._set[field](value)

    # -- the run's thread ----------------------------------------------------------------------------------------------

    def _work(self) -> None:
        self.outcome, failed = None, PansError("the run has ended")
        try:
            seen = Observers(self._watch, lambda run: self._tell(self._ready, run), self._stop)
            self.outcome = run_once(self._options, besides=seen)
            failed = LinkError(f"the run has ended: {self.outcome.summary.ended}")
        except PansError as error:
            failed = error
        except BaseException as error:
            failed.__cause__ = error
        self._tell(self._ended, failed)

    def _tell(self, future: asyncio.Future[Any], result: Any) -> None:
        self._loop.call_soon_threadsafe(lambda: None if future.done() else future.set_result(result))

    def _watch(self, run: Status, output: Output) -> None:
        rows = rows_of(output.decisions)
        if not len(rows):
            return
        if self._session is not run.session:  # maybe with another count of ticks
            self._session, self._last_tick = run.session, 0
        # no window begins before the one before has ended
        begins = np.append(np.uint64(self._last_tick), rows["tick"][:-1])
        self._last_tick = int(rows["tick"][-1])
        if self._asked is None:
            return
        asked_ns, answer = self._asked
        clock = run.session.known_clock()
        unsure_ns = clock.to_host_ns(clock.to_tick(asked_ns))[1]
        after = np.flatnonzero(begins >= clock.to_tick(asked_ns + unsure_ns))
        if not len(after):
            return
        self._asked, row = None, rows[after[0]]
        label, number = int(row["label"]), int(row["index"])
        abstained = label == NO_LABEL
        photons = np.nan if output.passages else run.core.marks.photons_of(row["object"][None].astype(np.int64))[0]
        facts = {
            "label": -1 if abstained else label,
            "class_name": "" if abstained else self._classes[label],
            "probability": float(row["probability"]),
            "clicks": int(row["clicks"]),
            "photons": float(photons) * self._options.shots,
            "late": number in run.accounts.late,
            "abstained": abstained,
            "flags": int(row["flags"]),
            "number": number,
            "tick": int(row["tick"]),
        }
        self._tell(answer, facts)
