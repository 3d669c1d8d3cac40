"""What a notebook needs: train a sensor, load a profile, a bundle or a recording, run on a device, replay, evaluate, decide on clicks.

This is `import pans`; what a name needs is loaded when it is first used. Each call is a few lines around the rooms, which have the rest
(docs/explanation/architecture.md).

>>> import pans
>>> bundle = pans.load_bundle("fashion10")
>>> pans.decide(bundle, [0b0000000001, 0b1010000000]).labels.shape
(2,)
>>> done = pans.run(bundle, "sim:oled-qcmos?scene=fashion200&seed=1&pace=fast", decisions=20)
>>> done.summary.decisions, done.recording
(20, None)
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pans.base import __version__ as __version__
from pans.base.console import install
from pans.base.errors import UsageError, in_python_words

if TYPE_CHECKING:
    from pans.app.run import Outcome
    from pans.bundle.backends import Verdicts
    from pans.bundle.backends import decide_clicks as decide
    from pans.bundle.sensor import Bundle
    from pans.decide.plan import build_plan
    from pans.instrument.profile import Profile, load_profile
    from pans.record.reading import Recording
    from pans.record.reading import open_recording as load_recording
    from pans.record.replay import Replayed, replay
    from pans.record.tables import to_frame, to_xarray
    from pans_trainer.evaluate import Measured, MeasuredPictures, MeasuredWalks, evaluate
    from pans_trainer.own_images.estimator import PansClassifier
    from pans_trainer.own_images.own import train_own as train
    from pans_trainer.own_images.results import CameraResults, SensorResults

_HOMES = {
    "Bundle": ("pans.bundle.sensor.bundle", "Bundle"),
    "CameraResults": ("pans_trainer.own_images.results", "CameraResults"),
    "Measured": ("pans_trainer.evaluate", "Measured"),
    "MeasuredPictures": ("pans_trainer.evaluate", "MeasuredPictures"),
    "MeasuredWalks": ("pans_trainer.evaluate", "MeasuredWalks"),
    "Outcome": ("pans.app.run.one_run", "Outcome"),
    "PansClassifier": ("pans_trainer.own_images.estimator", "PansClassifier"),
    "Profile": ("pans.instrument.profile", "Profile"),
    "Recording": ("pans.record.reading.recording", "Recording"),
    "Replayed": ("pans.record.replay", "Replayed"),
    "SensorResults": ("pans_trainer.own_images.results", "SensorResults"),
    "Verdicts": ("pans.bundle.backends.verdict", "Verdicts"),
    "build_plan": ("pans.decide.plan.plan", "build_plan"),
    "decide": ("pans.bundle.backends.choose", "decide_clicks"),
    "evaluate": ("pans_trainer.evaluate", "evaluate"),
    "load_profile": ("pans.instrument.profile", "load_profile"),
    "load_recording": ("pans.record.reading.parts", "open_recording"),
    "replay": ("pans.record.replay", "replay"),
    "to_frame": ("pans.record.tables.tables", "to_frame"),
    "to_xarray": ("pans.record.tables.tables", "to_xarray"),
    "train": ("pans_trainer.own_images.own", "train_own"),
}
__all__ = [
    "Bundle",
    "CameraResults",
    "Measured",
    "MeasuredPictures",
    "MeasuredWalks",
    "Outcome",
    "PansClassifier",
    "Profile",
    "Recording",
    "Replayed",
    "SensorResults",
    "Verdicts",
    "__version__",
    "build_plan",
    "decide",
    "evaluate",
    "load_bundle",
    "load_profile",
    "load_recording",
    "replay",
    "run",
    "to_frame",
    "to_xarray",
    "train",
]


_trained = {name for name, (module, _) in _HOMES.items() if module.startswith("pans_trainer")}
_lacks = {package for package in ("torch", "onnx", "sklearn") if find_spec(package) is None}
# `from pans import *`, `help(pans)` and `inspect` load each name, and would end at one whose extra is not installed.
for _name in _trained if _lacks - {"sklearn"} else {"PansClassifier"} if _lacks else ():
    __all__.remove(_name)


class MissingExtraError(UsageError, AttributeError):
    """A name of `pans` whose extra is not installed: there is no such attribute, and the remedy says how to get it."""


def __getattr__(name: str) -> object:
    """Load a name when it is first used, since its package loads numba or torch (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module 'pans' has no attribute {name!r}")
    module, found = _HOMES[name]
    try:
        globals()[name] = getattr(import_module(module), found)
    except ModuleNotFoundError as error:
        if not module.startswith("pans_trainer"):
            raise
        package, extra = (error.name or "").partition(".")[0], "sklearn" if name == "PansClassifier" else "train"
        what = f"pans.{name} needs the package {package}, which is not installed"
        if sys._getframe(1).f_globals.get("__name__") == "importlib._bootstrap":
            # `from pans import NAME`: of an AttributeError Python would say that it cannot import the name, and no more
            raise ImportError(f"{what}: {install(extra)}", name=package) from error
        raise MissingExtraError(what, remedy=install(extra)) from error
    return globals()[name]


def __dir__() -> list[str]:
    return sorted(__all__)


def load_bundle(path: str | Path) -> Bundle:
    """Return the bundle at `path` (.pans), or a shipped one by its name; UsageError or DamagedFileError if it cannot be read.

    >>> load_bundle("fashion10").n_features
    10
    """
    from pans.bundle.sensor import load_bundle

    return load_bundle(path)[0]


def run(
    bundle: Bundle | str | Path,
    device: str,
    *,
    profile: Profile | str | None = None,
    decisions: int = 0,
    seconds: float = 0.0,
    shots: int = 1,
    out: str | Path | None = None,
    shows: bool = False,
    force: bool = False,
    **more: Any,
) -> Outcome:
    """Run `bundle` on the device behind a URL until `decisions` are made or `seconds` have passed; without both, until interrupted.

    It is what `pans run` does: `out` is a folder for the recording and a page (None: neither; UsageError if they
    are there already, unless `force`), `shows` draws the live view on stderr. `more` are other fields of
    `pans.live.options.RunOptions`, such as `dark_slots=4` or `on_dark="abstain"`; UsageError for one that is not there.
    `profile` is by default the one that a `sim:` URL names. The result has `summary` (`accuracy`, `verdict`, ...; `as_json()` is what
    the command prints), `confusion`, and the paths `recording` and `report`. DeviceError and LinkError if the device cannot be armed.
    """
    from dataclasses import fields
    from tempfile import TemporaryDirectory

    from pans.app.run import profile_of, run_once
    from pans.bundle.sensor import bundle_path
    from pans.instrument.profile import Profile, load_profile
    from pans.live.options import RunOptions

    if unknown := more.keys() - {one.name for one in fields(RunOptions)}:
        what = f"pans.run has no option {', '.join(sorted(unknown))}"
        raise UsageError(what, remedy="help(pans.live.options.RunOptions) lists them")
    loaded = profile if isinstance(profile, Profile) else load_profile(profile or profile_of(device))
    with TemporaryDirectory() as folder:
        path = bundle_path(bundle) if isinstance(bundle, (str, Path)) else _written(bundle, Path(folder))
        options = RunOptions(
            bundle=path,
            device=device,
            out=None if out is None else Path(out),
            shots=shots,
            decisions=decisions,
            seconds=seconds,
            realtime=False,
            command="pans.run",
            display=shows,
            force=force,
            **more,
        )
        with in_python_words():
            return run_once(options, loaded)


def _written(bundle: Bundle, folder: Path) -> Path:
    from pans.base.console import file_name
    from pans.bundle.sensor import write_bundle

    path = folder / f"{file_name(bundle.name)}.pans"
    write_bundle(bundle, path)
    return path
