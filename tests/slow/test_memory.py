"""What a file can cost: none that is accepted takes 400 MiB to be verified, run or replayed, program and simulated instrument included.

Each command runs in a process of its own. The long form (`-m slow`) takes all kinds of files.
"""

from __future__ import annotations

import sys
from pathlib import Path

import large_files
import pytest
from large_files import AUTOMATA, BUNDLES
from peak_memory import peak_of

from pans.runtime.bundle.model import write_bundle

MOST_MIB = 400
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
RUN = ["--decisions", "20", "--no-realtime", "--record", "run.pansrec"]


def demand_small(folder: Path, codes: tuple[int, ...], *words: str) -> None:
    """Run a command; demand its exit code and its memory."""
    peak = peak_of(words, folder)
    assert peak.code in codes, peak.said
    assert peak.mib < MOST_MIB, f"{' '.join(words)}: {peak.mib:.0f} MiB"
    print(f"{' '.join(words)}: {peak.mib:.0f} MiB")


def test_a_bundle_as_large_as_it_may_be(tmp_path: Path) -> None:
    write_bundle(large_files.large_table(), tmp_path / "b.pans")
    demand_small(tmp_path, (0, 1), "verify", "b.pans")


def test_an_automaton_whose_patterns_unpack_to_the_most(tmp_path: Path) -> None:
    write_bundle(large_files.large_automaton(), tmp_path / "b.pans")
    demand_small(tmp_path, (0, 1), "verify", "b.pans")


@pytest.mark.slow
@pytest.mark.parametrize("name", AUTOMATA)
def test_every_kind_of_large_automaton_and_its_recording(name: str, tmp_path: Path) -> None:
    write_bundle(AUTOMATA[name](), tmp_path / "b.pans")
    demand_small(tmp_path, (0, 1), "info", "b.pans")
    demand_small(tmp_path, (0, 1), "run", "b.pans", "--device", "sim:dmd-spad?scene=uniform&pace=fast", *RUN)
    for command in ("verify", "replay", "info"):
        demand_small(tmp_path, (0, 1), command, "run.pansrec")


@pytest.mark.slow
@pytest.mark.parametrize("name", BUNDLES)
def test_every_kind_of_large_bundle_and_its_recording(name: str, tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    write_bundle(BUNDLES[name](), tmp_path / "b.pans")
    optics = "&optics=b.pans" if name == "large_matrix" else ""
    demand_small(tmp_path, (0, 1), "verify", "b.pans")
    demand_small(tmp_path, (0, 1), "run", "b.pans", "--device", f"sim:ideal?scene=uniform&pace=fast{optics}", *RUN)
    for command in ("verify", "replay", "info"):
        demand_small(tmp_path, (0, 1), command, "run.pansrec")


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(16, 2048, 2040), (85_000, 28, 28)], ids=["large pictures", "many pictures"])
def test_a_scene_as_large_as_it_may_be(shape: tuple[int, int, int], tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    write_bundle(large_files.scene_bundle(shape[1:]), tmp_path / "b.pans")
    large_files.large_scene(tmp_path / "s.npz", shape)
    demand_small(tmp_path, (0, 1), "run", "b.pans", "--device", "sim:ideal?scene=s.npz&pace=fast", *RUN)


@pytest.mark.slow
def test_a_recording_of_any_length(tmp_path: Path) -> None:
    large_files.long_recording(tmp_path / "long.pansrec", 2_000_000)
    demand_small(tmp_path, (0, 1), "verify", "long.pansrec")


@pytest.mark.slow
def test_json_of_many_values(tmp_path: Path) -> None:
    large_files.large_json(tmp_path / "lab.json")
    demand_small(tmp_path, (1, 2), "verify", "lab.json")
