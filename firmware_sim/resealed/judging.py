"""`pans fuzz --files`: changed files with right checksums, verified, and used where they were accepted.

Owns the files to begin with, the limits and the judgement. `fuzz_files` returns counts and "" or what went wrong; a seed repeats it.
"""

from __future__ import annotations

import random
import resource
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pans.firmware_sim.testing import small_automaton_bundle, small_setup
from pans.hw_profiles import __file__ as _profiles
from pans.runtime import SHIPPED
from pans.runtime.bundle.model import BackEnd, Shown, bundle_bytes, load_bundle, make_bundle
from pans.runtime.errors import PansError
from pans.runtime.report.verify import verify_file

from .contents import mutated_toml
from .sealing import changed_bundle, changed_calibration, changed_recording
from .uses import passive_bundle, record_automaton, record_flow, record_passive, record_run, small_calibration, use_file

ANSWER_S = 2.0  # of processor time for one answer; the files have up to 140 kB
MEMORY_MIB = 400


@dataclass(slots=True)
class FileCounts:
    """How many files were made of each kind, how many were accepted, and the slowest answer."""

    made: Counter[str] = field(default_factory=Counter)
    accepted: Counter[str] = field(default_factory=Counter)
    slowest_answer_s: float = 0.0

    @property
    def files(self) -> int:
        """All files that were made."""
        return sum(self.made.values())


class LimitBroken(AssertionError):
    """A file that took too long or too much memory, or that was accepted and could not be used."""


@dataclass(slots=True)
class _Kind:
    files: list[bytes]
    change: Callable[[random.Random, bytes], bytes]
    suffix: str
    share: int


def fuzz_files(seed: int, count: int, folder: Path) -> tuple[FileCounts, str]:
    """Make `count` changed files in `folder`; return the counts, and "" or the traceback of the first that broke a rule."""
    dice, counts = random.Random(seed), FileCounts()
    kinds = _base_files()
    names = list(kinds)
    shares = [kinds[name].share for name in names]
    _warm_up(kinds, folder)
    before_mib = _peak_mib()
    for number in range(count):
        name = dice.choices(names, shares)[0]
        kind = kinds[name]
        data = kind.change(dice, dice.choice(kind.files))
        path = folder / f"changed{kind.suffix}"
        path.write_bytes(data)
        counts.made[name] += 1
        try:
            _judge(name, path, counts)
            if _peak_mib() - before_mib > MEMORY_MIB:
                raise LimitBroken(f"{_peak_mib() - before_mib:.0f} MiB more than before, allowed: {MEMORY_MIB}")
        except Exception:
            kept = Path(tempfile.mkdtemp(prefix="pans-fuzz-")) / f"seed-{seed}-file-{number}{kind.suffix}"
            kept.write_bytes(data)
            return counts, f"{traceback.format_exc()}\nseed {seed}, file {number} ({name}), kept as {kept}"
    return counts, ""


def _warm_up(kinds: dict[str, _Kind], folder: Path) -> None:
    """Use every file as it is, so that no answer is charged with a compiler or a library that is loaded."""
    for name, kind in kinds.items():
        for number, data in enumerate(kind.files):
            path = folder / f"whole-{number}{kind.suffix}"
            path.write_bytes(data)
            if name != "scene":  # its pictures lie elsewhere
                use_file(name, path)
            path.unlink()


def _judge(name: str, path: Path, counts: FileCounts) -> None:
    accepted, taken_s = _answer(name, path)
    if taken_s > ANSWER_S:  # once more: a kernel may have been compiled for this kind of content
        accepted, taken_s = _answer(name, path)
    counts.accepted[name] += accepted
    counts.slowest_answer_s = max(counts.slowest_answer_s, taken_s)
    if taken_s > ANSWER_S:
        raise LimitBroken(f"{taken_s:.1f} s of processor time, allowed {ANSWER_S}")


def _answer(name: str, path: Path) -> tuple[bool, float]:
    """Return whether a file is accepted, and the processor time of that answer and its use in seconds."""
    started, accepted = time.process_time(), False
    try:
        if name in ("scene", "flow"):  # they have no verify of their own: being read is the check
            use_file(name, path)
            accepted = True
        else:
            verdict = verify_file(path)
            accepted = not verdict.violations and not verdict.damaged
            if accepted:
                _use(name, path)
    except PansError as error:
        if name not in ("scene", "flow"):
            raise LimitBroken(f"accepted by verify, refused later: {error}") from error
    return accepted, time.process_time() - started


def _use(name: str, path: Path) -> None:
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        use_file(name, path)


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _base_files() -> dict[str, _Kind]:
    profiles = [path.read_bytes() for path in sorted(Path(_profiles).parent.glob("*.toml"))]
    scenes = [path.read_bytes() for path in sorted((Path(__file__).parent.parent / "scenes").glob("*.toml"))]
    flows = [path.read_bytes() for path in sorted(SHIPPED.glob("flow-*.toml"))]

    def text(dice: random.Random, data: bytes) -> bytes:
        return mutated_toml(dice, data.decode()).encode("utf-8", "replace")

    return {
        "bundle": _Kind(_bundles(), changed_bundle, ".pans", 40),
        "recording": _Kind(_recordings(), changed_recording, ".pansrec", 25),
        "calibration": _Kind([_made(small_calibration)], changed_calibration, ".json", 15),
        "profile": _Kind(profiles, text, ".toml", 10),
        "scene": _Kind(scenes, text, ".toml", 6),
        "flow": _Kind(flows, text, ".toml", 4),
    }


def _bundles() -> list[bytes]:
    """The shipped bundle, a table alone, passive optics, pictures, photon numbers, automata of bits and of bytes."""
    shipped, _ = load_bundle(SHIPPED / "fashion10.pans")
    facts: dict[str, Any] = {"task": "small", "provenance": {"seed": 1, "losses": [0.5, 0.25]}}
    picture = make_bundle(
        name="picture",
        picture_shape=(2, 5),
        image_shape=(28, 28),
        optics=Shown(shipped.levels, shipped.pattern_levels, shipped.photons_per_level),
        back_end=BackEnd(head_onnx=shipped.head_onnx),
        **facts,
    )
    table = np.random.default_rng(3).normal(size=(3**4, 2))
    numbers = make_bundle(
        name="numbers",
        classes=("a", "b"),
        image_shape=(2, 2),
        optics=Shown(2, np.eye(4, dtype=np.int64), 0.2),
        back_end=BackEnd(table=table, outcomes=3),
        **facts,
    )
    automata = [small_automaton_bundle(levels) for levels in (2, 8)]
    return [
        bundle_bytes(bundle)
        for bundle in (shipped, small_setup()[1], small_setup()[1], passive_bundle(), picture, numbers, *automata)
    ]


def _recordings() -> list[bytes]:
    """Still objects, passive optics, cells in flow, an automaton."""

    def file_of(make: Callable[[Path], Path]) -> bytes:
        return _made(lambda folder: make(folder).read_bytes())

    return [file_of(make) for make in (record_run, record_passive, record_flow, record_automaton)]


def _made(make: Callable[[Path], bytes]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        return make(Path(folder))
