"""What a run says of itself: the header of its recording, the lines below the page's figures, its closing words.

Owns wording and keys alone; never measures. Each call returns text or a JSON-able map.
"""

from __future__ import annotations

import platform
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pans.runtime import __version__

from .run_flow import flow_words

if TYPE_CHECKING:
    from pans.runtime.decide.verdict import Decider

    from .run import Job


def what_was_run(
    job: Job, name: str, bundle_sha256: str, backend: str, recording: Path, summary: dict[str, Any]
) -> dict[str, str]:
    """The lines below the summary page's figures."""
    return {
        "bundle": f"{name} ({job.bundle_path.name}, SHA-256 {bundle_sha256[:16]}…)",
        "device": f"{job.device} (firmware {summary['device'].get('firmware', 'unknown')})",
        "profile": f"{job.profile.name}: {job.profile.description}",
        "decision back end": backend,
        "recording": f"{recording} (decision log SHA-256 {summary['decisions_sha256'][:16]}…; `pans replay` recomputes it)",
        "command": f"`{job.command}`",
        "machine": f"{platform.machine()}, Python {platform.python_version()}, pans {__version__}",
    }


def recording_header(job: Job, bundle_sha256: str, decider: Decider, n_objects: int) -> dict[str, Any]:
    """What a recording must say to be understood alone; units are in the keys."""
    import numba
    import numpy
    import onnxruntime

    from pans.runtime.decide.verdict import choice_of

    return {
        "bundle_sha256": bundle_sha256,
        "command": job.command,
        "device_url": job.device,
        "simulated": job.device.startswith("sim:"),
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


def closing_words(summary: dict[str, Any]) -> str:
    """The lines that the command ends with."""
    banner = "SIMULATED · " if summary["simulated"] else ""
    accuracy = "unknown" if summary["accuracy"] is None else f"{summary['accuracy']:.2%}"
    clicks = summary["clicks_mean"] or 0.0
    photons = "unknown" if summary["photons_mean"] is None else f"{summary['photons_mean']:.2f}"
    latency = summary["latency_us"]
    lines = [
        f"{banner}{summary['verdict']}: {summary['decisions']} decisions ({summary['objects']} objects × {summary['trials']} trials)",
        f"  accuracy      {accuracy} at {clicks:.2f} clicks, {photons} photons, illumination {summary['illumination']:.1f} each",
        f"  latency       p50 {latency['p50']:.0f} us, p99 {latency['p99']:.0f} us, p99.9 {latency['p999']:.0f} us, "
        f"max {latency['max']:.0f} us; late {summary['late']}, lost {summary['lost']}",
        *(flow_words(summary) if "flow" in summary else ()),
        *(f"  fault         {fault}" for fault in summary["faults"]),
        f"  recording     {summary['recording']}",
        f"  report        {summary['report']}",
    ]
    return "\n".join(lines)
