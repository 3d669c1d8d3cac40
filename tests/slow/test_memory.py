"""What a file can cost: none that is accepted takes 400 MiB to be verified, run or replayed, program and simulated instrument included.

Each command runs in a process of its own. The long form (`-m slow`) takes all kinds of files (large_files.py).
"""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import large_files as large
import pytest

from pans.bundle.sensor import Bundle
from pans.bundle.sensor.bundle import write_bundle

MOST_MIB = 400
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
RUN = ["--decisions", "20", "--no-realtime", "--record", "run.pansrec"]
IDEAL, FOLLOWING = "sim:ideal?scene=uniform&pace=fast", "sim:dmd-spad?scene=uniform&pace=fast"
# VmHWM: ru_maxrss would begin with that of the process that started this one
CODE = """
import json, sys
from pans.app.main import main
code = main(sys.argv[1:])
status = dict(line.split(":", 1) for line in open("/proc/self/status"))
print(json.dumps([code, int(status["VmHWM"].split()[0]) / 1024]))
"""


def demand_small(folder: Path, codes: tuple[int, ...], *words: str) -> None:
    """Run a command; demand its exit code and its memory."""
    asked = [sys.executable, "-c", CODE, *words]
    done = subprocess.run(asked, cwd=folder, capture_output=True, text=True, timeout=300, check=True)
    code, mib = json.loads(done.stdout.splitlines()[-1])
    print(f"{' '.join(words)}: {mib:.0f} MiB")
    assert code in codes, done.stderr
    assert mib < MOST_MIB, f"{' '.join(words)}: {mib:.0f} MiB"


@pytest.mark.parametrize("make", [large.large_table, large.large_automaton])
def test_a_bundle_as_large_as_it_may_be(make: Callable[[], Bundle], tmp_path: Path) -> None:
    write_bundle(make(), tmp_path / "b.pans")
    demand_small(tmp_path, (0, 1), "verify", "b.pans")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "device"),
    [
        (large.many_patterns, IDEAL),
        (large.large_patterns, IDEAL),
        (large.large_head, IDEAL),
        (large.wide_results, IDEAL),
        (large.large_matrix, f"{IDEAL}&optics=b.pans"),
        (large.large_automaton, FOLLOWING),
        (large.many_states, FOLLOWING),
        (large.large_pictures, "sim:ideal?scene=s.npz&pace=fast"),
        (large.many_pictures, "sim:ideal?scene=s.npz&pace=fast"),
    ],
    ids=lambda one: getattr(one, "__name__", ""),
)
def test_every_kind_of_large_bundle_and_its_recording(
    make: Callable[[], Bundle], device: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("onnx")
    monkeypatch.chdir(tmp_path)  # where the scene of pictures goes
    write_bundle(make(), tmp_path / "b.pans")
    demand_small(tmp_path, (0, 1), "run", "b.pans", "--device", device, *RUN)
    demand_small(tmp_path, (0, 1), "info" if device == FOLLOWING else "verify", "b.pans")
    for command in ("verify", "replay", "info"):
        demand_small(tmp_path, (0, 1), command, "run.pansrec")


@pytest.mark.slow
def test_a_recording_of_any_length(tmp_path: Path) -> None:
    large.long_recording(tmp_path / "long.pansrec", 2_000_000)
    demand_small(tmp_path, (0, 1), "verify", "long.pansrec")


@pytest.mark.slow
def test_json_of_many_values(tmp_path: Path) -> None:
    large.large_json(tmp_path / "lab.json")
    demand_small(tmp_path, (1, 2), "verify", "lab.json")
