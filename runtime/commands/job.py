"""What one `pans run` is to do, resolved, and how a recording and a page tell it.

Owns the keys of the recording's header, and what a dose cap means for the bundle; never measures and never runs anything.
"""

from __future__ import annotations

import platform
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pans.runtime import __version__
from pans.runtime.errors import UsageError
from pans.runtime.flow.settings import FlowSettings
from pans.runtime.instrument.profile import Profile
from pans.runtime.live.config import DarkSettings
from pans.runtime.live.continuous import Continuous

if TYPE_CHECKING:
    from pans.runtime.bundle.automaton import DoseCap
    from pans.runtime.bundle.model import Bundle
    from pans.runtime.core.plan import Plan
    from pans.runtime.decide.verdict import Decider
    from pans.runtime.report.summary import Summary

ROUNDING = 1e-9  # of a dose cap: a sum of light is known to so many digits


@dataclass(frozen=True, slots=True)
class Job:
    """What one call of the command is to do, resolved."""

    bundle_path: Path
    device: str
    profile: Profile
    deadline_us: float
    act_profile: Profile
    out: Path | None = (
        None  # folder for the recording and the summary page; None: no page, and no recording but `record`
    )
    out_root: Path | None = None  # a new folder named by date and `run_name` is made in here, and becomes `out`
    run_name: str = "run"
    record: Path | None = None
    force: bool = False  # replace what exists
    inputs: tuple[Path, ...] = ()  # files that are read, beside bundle, calibration and those in the device's URL
    shots: int = 1
    trials: int = 1
    decisions: int = 0
    seconds: float = 0.0
    order: str = "auto"
    dark_slots: int = 1
    backend: str = "auto"
    drive: str = "auto"  # of an automaton
    confidence: float = 0.0  # at which an automaton decides; 0: where its walk ends
    dose_cap: float = 0.0  # most illumination of one object; 0: no cap
    realtime: bool = True
    core: int | None = None
    turn: str = "auto"
    reconnect_s: float = 10.0
    trace: Path | None = None
    command: str = ""
    flow: FlowSettings | None = None
    act: str = "device"
    dark: DarkSettings = field(default_factory=DarkSettings)
    continuous: Continuous = field(default_factory=Continuous)
    seed: int | None = None  # of a simulated detector, where the command has one
    shows: bool = True  # what is happening, on stderr
    serve: str = ""  # HOST:PORT of the live page

    @property
    def recording(self) -> Path | None:
        """The recording to write, if any."""
        return self.record if self.record or self.out is None else self.out / "run.pansrec"

    @property
    def page(self) -> Path | None:
        """The summary page to write, if any."""
        if self.out is not None:
            return self.out / "summary.md"
        return None if self.record is None else self.record.with_name(f"{self.record.stem}.summary.md")

    @property
    def left_recording(self) -> Path | None:
        """What names the recording afterwards: of one in parts its index."""
        if self.recording is None or self.continuous.limits is None:
            return self.recording
        from pans.runtime.record.part_keeper import index_path

        return index_path(self.recording)


def what_was_run(job: Job, name: str, bundle_sha256: str, backend: str, summary: Summary) -> dict[str, str]:
    """The lines below the summary page's figures."""
    return {
        "bundle": f"{name} ({job.bundle_path.name}, SHA-256 {bundle_sha256[:16]}…)",
        "device": f"{job.device} (firmware {summary.device.get('firmware', 'unknown')})",
        "profile": f"{job.profile.name}: {job.profile.description}",
        "decision back end": backend,
        "recording": f"{job.left_recording} (decision log SHA-256 {summary.decisions_sha256[:16]}…; pans replay recomputes it)",
        "command": job.command,
        "machine": f"{platform.machine()}, Python {platform.python_version()}, pans {__version__}",
    }


def recording_header(job: Job, bundle_sha256: str, decider: Decider, n_objects: int, plan: Plan) -> dict[str, Any]:
    """What a recording must say to be understood alone; units are in the keys."""
    import numba
    import numpy
    import onnxruntime

    from pans.runtime.decide.verdict import choice_of

    dose = getattr(decider, "dose", None)
    return {
        "bundle_sha256": bundle_sha256,
        "command": job.command,
        "device_url": job.device,
        "profile": {"name": job.profile.name, "sha256": job.profile.sha256, "toml": job.profile.text},
        "config": {
            "shots": job.shots,
            "trials": job.trials,
            "objects": n_objects,
            "seconds": job.seconds,
            "deadline_us": job.deadline_us,
            "order": job.order,
            "dark_slots_per_cycle": job.dark_slots,
            "backend": decider.name,
            "backend_choice": dict(choice_of(decider)),
            "tick_hz": job.profile.clock.tick_hz,
            "realtime_requested": job.realtime,
            **({"mode": "parallel"} if job.profile.mode == "parallel" else {}),
            **({"drive": plan.drive, "confidence": job.confidence} if plan.drive else {}),
            **({"photon_number_max": plan.largest} if plan.largest > 1 and plan.channels_at_once == 1 else {}),
            **({"channels_at_once": plan.channels_at_once} if plan.channels_at_once > 1 else {}),
            **({"dose_cap": job.dose_cap} if job.dose_cap else {}),
            **({"walk_dose": {"most": dose.most, "states": dose.states}} if dose is not None else {}),
        },
        "versions": {
            "pans": __version__,
            "python": platform.python_version(),
            "numpy": numpy.__version__,
            "numba": numba.__version__,
            "onnxruntime": onnxruntime.__version__,
            "platform": platform.platform(),
        },
    }


def stops_of(job: Job, bundle: Bundle) -> dict[str, Any]:
    """Return where walks end before their leaf, as `make_decider` takes it; UsageError as `dose_of`."""
    return {"confidence": job.confidence, "dose": dose_of(job, bundle)}


def dose_of(job: Job, bundle: Bundle) -> DoseCap | None:
    """Return what each walk of an automaton may bring, so that no object receives more than `job.dose_cap`; None of fixed patterns.

    UsageError where the cap cannot be kept: for fixed patterns that bring more, passive bundles, objects in flow, and patterns that a
    registration changes.
    """
    if not job.dose_cap:
        return None
    if bundle.analyser is not None or job.flow is not None or job.dark.registration is not None:
        raise UsageError(
            "--dose-cap is for patterns that are shown to one object after another as the bundle states them: not for passive optics, "
            "--flow or --registration",
            remedy="leave --dose-cap out, or the other one",
        )
    if bundle.automaton is not None:
        from pans.runtime.bundle.automaton import STATES_MAX, DoseCap

        return DoseCap(job.dose_cap / job.trials, min(job.profile.projector.automaton_states or STATES_MAX, STATES_MAX))
    light = bundle.illumination() * job.shots * job.trials
    if light > job.dose_cap * (1 + ROUNDING):
        raise UsageError(
            f"{bundle.name} sends {light:.6g} photoelectrons of illumination to an object ({bundle.n_features} patterns, {job.shots} "
            f"shots, {job.trials} trials), --dose-cap allows {job.dose_cap:.6g}",
            remedy="pans order BUNDLE --by dose --dose-cap N makes a bundle of as many patterns as stay below; or fewer shots or trials",
        )
    return None
