"""Recordings of small runs in virtual time, through the live loop, in one file or in parts."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pans.bundle.backends.choose import make_decider
from pans.bundle.sensor import bundle_bytes
from pans.decide.still.core import Core
from pans.live.loop import Job, Observers, Recovery, RunResult, Status, run_live
from pans.live.options import RunOptions
from pans.record.reading.decision_log import LogEncoder
from pans.record.recorder import PartLimits, Recorder
from pans_sim.ports.serve import open_sim
from pans_sim.testing import small_setup


class Disk:
    """A file some of whose methods are others."""

    def __init__(self, file: Any, **methods: Any) -> None:
        self._file = file
        vars(self).update(methods)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def fails(number: int) -> Any:
    """A method of a disk that fails with this errno."""

    def method(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    return method


def log_sha256(rows: np.ndarray) -> str:
    """The SHA-256 (hex) of decisions, DECISION_DTYPE (n,), in their order: what replay compares."""
    log = LogEncoder()
    log.update(rows)
    return log.hexdigest()


def record_small(
    path: Path,
    cycles: int = 1800,
    *,
    faults: str = "",
    seed: int = 4,
    limits: PartLimits | None = None,
    prepared: Any = None,
) -> RunResult:
    """Record a run of fixed patterns, ended by `close`, in blocks of few milliseconds of the device's time."""
    profile, bundle, plan = small_setup()
    url = f"sim:ideal?scene=uniform&pace=fast&seed={seed}&faults={faults}"
    link = open_sim(url)
    header = {"config": {"shots": 1, "tick_hz": profile.clock.tick_hz, "backend": "table"}, "simulated": True}
    header["profile"] = {"name": profile.name, "sha256": profile.sha256, "toml": profile.text}
    core = Core(plan, make_decider(bundle, backend="table"), 1, cycles)
    config = RunOptions(n_cycles=cycles, deadline_us=1e9, realtime=False)
    path.parent.mkdir(exist_ok=True)
    with Recorder(path, header, bundle=bundle_bytes(bundle), limits=limits) as recorder:

        def wait(run: Status, output: Any) -> None:
            """Let virtual time not outrun the disk: the next part is made by a thread."""
            if limits is not None and recorder.open_file.size_bytes >= limits.rotate_bytes:
                recorder._next.result(timeout=20)

        observers, recovery = Observers(wait, prepared), Recovery.of(link, url, 10.0)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("pans.live.loop.FLUSH_EVERY_NS", 20_000_000)
            result = run_live(link, Job(profile, bundle, plan, config), core, recorder, recovery, observers)
        result.decisions_sha256 = recorder.close({"decisions": result.tally.decisions})
    return result
