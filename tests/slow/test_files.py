"""Changed contents under right checksums: `verify` answers within its limits, and what it accepts can be used.

Hypothesis chooses what is changed: a value of JSON, a line of TOML, numbers of an array, a block of a recording.
"""

import resource
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import small_files
from changed_files import changed_bundle, changed_calibration, changed_recording, changed_toml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tree import ROOT

from pans.base import SHIPPED
from pans.base.errors import PansError
from pans.bundle.sensor import bundle_bytes
from pans.report.files.verify import verify_file
from pans_sim import __file__ as SIMULATOR
from pans_sim.testing import small_automaton_bundle, small_setup

pytestmark = pytest.mark.slow
ANSWER_S, MEMORY_MIB = 2.0, 400  # of processor time for one answer, and more than before; the files have up to 140 kB
CASE = settings(max_examples=400, deadline=None, suppress_health_check=list(HealthCheck))


def answer(kind: str, path: Path) -> float:
    """Verify a file and use it where it is accepted; return the processor time that it took. Scenes and flow files are read."""
    started = time.process_time()
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        if kind in ("scene", "flow"):
            with suppress(PansError):
                small_files.use_file(kind, path)
        elif not ((verdict := verify_file(path)).violations or verdict.damaged):
            small_files.use_file(kind, path)
    return time.process_time() - started


def check(kind: str, suffix: str, folder: Path, data: bytes) -> None:
    """Write a changed file and have it answered; once more where the first answer was slow: it may have compiled a kernel."""
    path = folder / f"changed{suffix}"
    path.write_bytes(data)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    if answer(kind, path) > ANSWER_S:
        assert answer(kind, path) < ANSWER_S
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 - before < MEMORY_MIB


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("files")


@pytest.fixture(scope="module")
def sound(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[bytes]]:
    """Sound files of each kind."""
    small = [small_setup()[1], small_files.passive_bundle(), *(small_automaton_bundle(levels) for levels in (2, 8))]
    makers = (small_files.record_run, small_files.record_passive, small_files.record_flow, small_files.record_automaton)
    shipped = {
        "bundle": [SHIPPED / "fashion10.pans"],
        "recording": [make(tmp_path_factory.mktemp("run")) for make in makers],
        "profile": sorted(ROOT / "hw_profiles".glob("*.toml")),
        "scene": sorted((Path(SIMULATOR).parent / "scenes").glob("*.toml")),
        "flow": sorted(SHIPPED.glob("flow-*.toml")),
    }
    files = {kind: [path.read_bytes() for path in paths] for kind, paths in shipped.items()}
    files["bundle"] += map(bundle_bytes, small)
    return files | {"calibration": [small_files.small_calibration(folder)]}


KINDS = {
    "bundle": (".pans", changed_bundle),
    "recording": (".pansrec", changed_recording),
    "calibration": (".json", changed_calibration),
    "profile": (".toml", changed_toml),
    "scene": (".toml", changed_toml),
    "flow": (".toml", changed_toml),
}


@pytest.mark.parametrize("kind", KINDS)
@CASE
@given(data=st.data())
def test_changed_files_are_refused_or_can_be_used(
    kind: str, folder: Path, sound: dict[str, list[bytes]], data: st.DataObject
) -> None:
    suffix, change = KINDS[kind]
    check(kind, suffix, folder, data.draw(change(data.draw(st.sampled_from(sound[kind])))))
