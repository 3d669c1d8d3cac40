"""What a notebook needs: train a sensor, load a profile, a bundle or a recording, run on a device, replay, evaluate, decide on clicks.

This is `import pans`; what a name needs is loaded when it is first used. Each call is a few lines around the packages, which have the
rest (pans.runtime.bundle, .instrument, .core, .record, .live, .report, pans.trainer).

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

from pans.runtime import __version__ as __version__
from pans.runtime.errors import UsageError, as_usage_error, in_python_words
from pans.runtime.offered import install

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from pans.runtime.bundle.model import Bundle
    from pans.runtime.commands.one_run import Outcome
    from pans.runtime.core.plan import build_plan
    from pans.runtime.decide.verdict import Verdicts
    from pans.runtime.instrument.profile import Profile, load_profile
    from pans.runtime.record import Recording
    from pans.runtime.record.parts import open_recording as load_recording
    from pans.runtime.record.replaying import Replayed, replay
    from pans.trainer.choose.estimator import PansClassifier
    from pans.trainer.choose.own import train_own as train
    from pans.trainer.choose.results import CameraResults, SensorResults
    from pans.trainer.evaluate import Measured, MeasuredPictures, MeasuredWalks, evaluate

_HOMES = {
    "Bundle": ("pans.runtime.bundle.model", "Bundle"),
    "CameraResults": ("pans.trainer.choose.results", "CameraResults"),
    "Measured": ("pans.trainer.evaluate", "Measured"),
    "MeasuredPictures": ("pans.trainer.evaluate", "MeasuredPictures"),
    "MeasuredWalks": ("pans.trainer.evaluate", "MeasuredWalks"),
    "Outcome": ("pans.runtime.commands.one_run", "Outcome"),
    "PansClassifier": ("pans.trainer.choose.estimator", "PansClassifier"),
    "Profile": ("pans.runtime.instrument.profile", "Profile"),
    "Recording": ("pans.runtime.record", "Recording"),
    "Replayed": ("pans.runtime.record.replaying", "Replayed"),
    "SensorResults": ("pans.trainer.choose.results", "SensorResults"),
    "Verdicts": ("pans.runtime.decide.verdict", "Verdicts"),
    "build_plan": ("pans.runtime.core.plan", "build_plan"),
    "evaluate": ("pans.trainer.evaluate", "evaluate"),
    "load_profile": ("pans.runtime.instrument.profile", "load_profile"),
    "load_recording": ("pans.runtime.record.parts", "open_recording"),
    "replay": ("pans.runtime.record.replaying", "replay"),
    "train": ("pans.trainer.choose.own", "train_own"),
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
    "train",
]


_trained = {name for name, (module, _) in _HOMES.items() if module.startswith("pans.trainer")}
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
        if not module.startswith("pans.trainer"):
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
    from pans.runtime.bundle.model import load_bundle

    return load_bundle(path)[0]


def decide(bundle: Bundle, clicks: ArrayLike, *, shots: int = 1, backend: str = "auto") -> Verdicts:
    """Return `labels`, uint16 (n,), and `probabilities` of the winning classes, float32 (n,), for clicks of n objects.

    `clicks` are integers: words (n,) of one shot, in which bit k is pattern k's click, or counts (n, d_f) of `shots` shots; of a bundle
    that takes photon numbers, sums of those. UsageError for counts outside 0 to `shots` (times the largest number) or another shape.

    >>> bundle = load_bundle("fashion10")
    >>> words, counts = [0b11], [[1, 1, 0, 0, 0, 0, 0, 0, 0, 0]]
    >>> decide(bundle, words).labels == decide(bundle, counts).labels
    array([ True])
    """
    import numpy as np

    from pans.runtime.bundle.model import word_means
    from pans.runtime.decide.backends import make_decider
    from pans.runtime.decide.verdict import checked_counts, verdicts_of

    d_f, largest = bundle.n_features, bundle.largest
    try:
        found = np.asarray(clicks)
    except ValueError as error:
        raise UsageError(f"clicks are no array: {error}", remedy="give the same number of counts per object") from error
    if found.size and found.dtype.kind not in "iub":
        allowed = f"integers, words (n,) or counts (n, {d_f}) from 0 to {shots * largest}"
        remedy = "give whole numbers of clicks; means times shots are counts"
        raise UsageError(f"clicks are {found.dtype} {found.shape}, allowed: {allowed}", remedy=remedy)
    found = found.astype(np.int64) if found.dtype.kind != "u" else found
    if found.ndim == 1:
        if largest > 1 or d_f > 63:
            what = "takes photon numbers" if largest > 1 else f"has {d_f} patterns, and words hold at most 63 clicks"
            raise UsageError(f"words of clicks, but {bundle.name} {what}", remedy="give counts (n, d_f)")
        if found.size and (int(found.min()) < 0 or int(found.max()) >> d_f):
            raise UsageError(f"words run from {found.min()} to {found.max()}, allowed: {d_f} bits")
        found = word_means(found, d_f).astype(np.int64)
    with as_usage_error():
        counts = checked_counts(found, shots * largest, d_f)
    return verdicts_of(make_decider(bundle, shots=shots, backend=backend), counts, shots)


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
    `pans.runtime.live.RunOptions`, such as `dark_slots=4` or `on_dark="abstain"`; UsageError for one that is not there.
    `profile` is by default the one that a `sim:` URL names. The result has `summary` (`accuracy`, `verdict`, ...; `as_json()` is what
    the command prints), `confusion`, and the paths `recording` and `report`. DeviceError and LinkError if the device cannot be armed.
    """
    from dataclasses import fields
    from tempfile import TemporaryDirectory

    from pans.runtime.bundle.model import bundle_path
    from pans.runtime.commands.one_run import run_once
    from pans.runtime.commands.run import profile_of
    from pans.runtime.instrument.profile import Profile, load_profile
    from pans.runtime.live import RunOptions

    if unknown := more.keys() - {one.name for one in fields(RunOptions)}:
        what = f"pans.run has no option {', '.join(sorted(unknown))}"
        raise UsageError(what, remedy="help(pans.runtime.live.RunOptions) lists them")
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
    from pans.runtime.bundle.model import write_bundle
    from pans.runtime.safe_text import file_name

    path = folder / f"{file_name(bundle.name)}.pans"
    write_bundle(bundle, path)
    return path
