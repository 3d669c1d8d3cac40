"""A storage that fails at the n-th call, is full, tears a write or ends the process: no earlier file is lost, what is left is readable.

The commands that write are run on a storage with faults (storage.py) at every call, and on one that loses what was not synced
(power_cut.py).
"""

import errno
import itertools
import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from power_cut import Files, disk_of, states
from storage import Ended, Fault, FaultyStorage, compiler

from pans.app.main import main
from pans.base import SHIPPED
from pans.base.errors import DamagedFileError
from pans.bundle.sensor.bundle import load_bundle
from pans.instrument.calibration_file import load_calibration
from pans.live.watch.state_file import FORMAT, read_state
from pans.protocol.wire import FrameDecoder, MessageType, Opcode
from pans.protocol.wire.messages import decode_command
from pans.record.reading import read_recording
from pans.report.files.verify import verify_file

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not (compiler() and os.path.isdir("/proc/self/fd")), reason="needs a C compiler and Linux"),
]
KILLED = 137
PRECIOUS = {"notes.txt": b"mine", "out/earlier.pansrec": b"another run's", "out/pattern.csv": b"1,2"}
DEVICE = "sim:oled-qcmos?pace=fast"


@dataclass(frozen=True)
class Case:
    """One command: its words, and what it leaves when all is well."""

    words: str
    leaves: tuple[str, ...]
    needs: str = ""
    may: tuple[str, ...] = ()  # files that it may have rewritten: a run does not end because nobody can watch it


RUN = f"run b.pans --device {DEVICE} --decisions 40 --no-realtime --trace TRACE"
CASES = {
    "run": Case(f"{RUN} --out out/new", ("out/new/run.pansrec", "out/new/summary.md")),
    "run --state": Case(
        f"{RUN} --out out/new --state state.json", ("out/new/run.pansrec", "out/new/summary.md"), may=("state.json",)
    ),
    "run in parts": Case(f"{RUN} --rotate-mb 0.2 --out out", ("out/run-0001.pansrec", "out/summary.md")),
    "run --force": Case(f"{RUN} --record old.pansrec --force", ("old.pansrec", "old.summary.md")),
    "calibrate": Case(f"calibrate --device {DEVICE}&scene=uniform --seconds 0.5 -o c.json", ("c.json",)),
    "calibrate --force": Case(
        f"calibrate --device {DEVICE}&scene=uniform --seconds 0.5 -o old.json --force", ("old.json",)
    ),
    "export": Case("export r.pansrec --format csv -o out/csv", ("out/csv/about.json", "out/csv/clicks.csv")),
    "export hdf5": Case("export r.pansrec --format photon-hdf5 -o r.h5", ("r.h5",), "h5py"),
    "bundle": Case("bundle --patterns p.npy --table t.npy --classes a,b -o old.pans --force", ("old.pans",)),
    "train": Case(
        "train scene.npz --as-is --features 13 --epochs 3 --hidden 4 --batch 16 -o t.pans", ("t.pans",), "torch"
    ),
}
FAULTS = (
    (Fault.FAIL_ONCE, errno.EIO),
    (Fault.FAIL_ON, errno.EIO),
    (Fault.FAIL_ON, errno.ENOSPC),
    (Fault.SHORT, 0),
    (Fault.TORN, errno.ENOSPC),
    (Fault.CRASH, 0),
    (Fault.CRASH_TORN, 0),
)


@dataclass(frozen=True)
class Bench:
    """The storage, a folder with what the commands read, and a place outside for traces."""

    storage: FaultyStorage
    inputs: Path
    folder: Path
    trace: Path

    def fresh(self) -> dict[str, bytes]:
        """Lay out the folder again; return what is in it."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self.trace.unlink(missing_ok=True)
        shutil.copytree(self.inputs, self.folder)
        return contents(self.folder)

    def run(self, case: Case, at: int = 0, fault: Fault = Fault.NONE, error: int = 0, journal: str = "") -> Ended:
        """Run a command."""
        words = case.words.replace("TRACE", str(self.trace)).split()
        return self.storage.run(words, self.folder, at, fault, error, journal)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    base = tmp_path_factory.mktemp("storage")
    inputs = base / "inputs"
    (inputs / "out").mkdir(parents=True)
    for name, data in PRECIOUS.items():
        (inputs / name).write_bytes(data)
    shutil.copy(SHIPPED / "fashion10.pans", inputs / "b.pans")
    (inputs / "state.json").write_text(f'{{"format":"{FORMAT}"}}')
    np.save(inputs / "p.npy", np.ones((2, 4)))
    np.save(inputs / "t.npy", np.zeros((4, 2)))
    rng = np.random.default_rng(0)
    labels = np.arange(80) % 2
    images = (rng.integers(0, 60, (80, 6, 6)) + 180 * labels[:, None, None]).astype(np.uint8)
    np.savez(inputs / "scene.npz", images=images, labels=labels.astype(np.int16), classes=np.array(["a", "b"]))
    run = ["run", str(inputs / "b.pans"), "--device", DEVICE, "--decisions", "40"]
    assert main([*run, "--record", str(inputs / "r.pansrec")]) == 0
    shutil.copy(inputs / "r.pansrec", inputs / "old.pansrec")
    (inputs / "r.summary.md").rename(inputs / "old.summary.md")
    calibrate = ["calibrate", "--device", f"{DEVICE}&scene=uniform", "--seconds", "0.5"]
    assert main([*calibrate, "-o", str(inputs / "old.json")]) in (0, 1)
    shutil.copy(SHIPPED / "fashion10.pans", inputs / "old.pans")
    warm = [[*run, "--out", "warm"], [*calibrate, "-o", "warm.json"]]
    if find_spec("torch"):
        warm.append(["train", str(inputs / "scene.npz"), *CASES["train"].words.split()[2:]])
    storage = FaultyStorage(base, warm)
    yield Bench(storage, inputs, base / "work", base / "trace.txt")
    storage.close()


def contents(folder: Path) -> dict[str, bytes]:
    """Every file of a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def judge(bench: Bench, case: Case, before: dict[str, bytes], ended: Ended, fault: Fault) -> None:
    """Hold what a command left against what must be."""
    crashed = fault in (Fault.CRASH, Fault.CRASH_TORN) and ended.code == KILLED
    after = contents(bench.folder)
    assert crashed or ended.code in (0, 1, 2), ended
    assert "Traceback" not in ended.said, ended.said
    for name, data in before.items():
        assert name in after, f"{name} is gone"
        assert after[name] == data or name in (*case.leaves, *case.may), f"{name} was changed"
    new = {name for name, data in after.items() if before.get(name) != data}
    hidden = {name for name in new if Path(name).name.startswith(".")}
    if ended.code in (0, 1):
        assert set(case.leaves) <= new, f"exit code {ended.code} without {set(case.leaves) - new}"
    elif ended.code == 2:
        assert "pans: " in ended.said
        # where even removing fails something stays
        assert fault in (Fault.FAIL_ON, Fault.FAIL_ONCE) or not hidden, hidden
        if case.words.startswith("run"):
            assert light_is_off(bench.trace)
    for name in new - hidden:
        check_readable(bench.folder / name, whole=ended.code == 0)


def check_readable(path: Path, *, whole: bool) -> None:
    """A bundle and a calibration are whole or not there; a recording is replayed as far as it goes."""
    if path.suffix == ".pans":
        load_bundle(path)
    elif path.suffix == ".json" and path.name in ("c.json", "old.json"):
        load_calibration(path)
    elif path.name == "state.json":
        assert read_state(path) is not None
        json.loads(path.read_text())
    elif path.suffix == ".pansrec":
        verdict = verify_file(path)
        assert not verdict.damaged, verdict.violations
        recording = read_recording(path)
        assert recording.complete or not whole
        try:
            recording.bundle()
            replayed = main(["replay", str(path), "--json"])
        except DamagedFileError as error:
            pytest.fail(f"{path}: {error}")
        assert replayed == 0 or recording.n_decisions == 0


def light_is_off(trace: Path) -> bool:
    """Whether the last ARM that the device was sent is followed by STOP."""
    if not trace.exists():
        return True
    decoder, last = FrameDecoder(), Opcode.STOP
    for line in trace.read_text().splitlines():
        _, mark, text = line.split(" ", 2)
        if mark != ">":
            continue
        for frame in decoder.feed(bytes.fromhex(text)):
            if frame.type == MessageType.COMMAND:
                opcode = Opcode(decode_command(frame.payload).opcode)
                last = opcode if opcode in (Opcode.ARM, Opcode.STOP) else last
    return last is Opcode.STOP


@pytest.mark.parametrize("name", CASES)
def test_every_call_of_every_command(name: str, bench: Bench) -> None:
    case = CASES[name]
    if case.needs:
        pytest.importorskip(case.needs)
    before = bench.fresh()
    clean = bench.run(case)
    judge(bench, case, before, clean, Fault.NONE)
    assert clean.code in (0, 1), clean
    assert clean.calls > 0
    wrong = []
    for (fault, error), at in itertools.product(FAULTS, range(1, clean.calls + 1)):
        before = bench.fresh()
        ended = bench.run(case, at, fault, error)
        try:
            judge(bench, case, before, ended, fault)
        except (AssertionError, pytest.fail.Exception) as found:
            what = f"{fault.name} {errno.errorcode.get(error, '')} at call {at} of {clean.calls}"
            wrong.append(f"{what}: {found}; {ended}")
    assert not wrong, f"{name}, {len(wrong)} runs:\n" + "\n".join(wrong)


CUT = [name for name in CASES if name not in ("export hdf5", "train")]  # which write without `write`


def lay_out(folder: Path, files: Files) -> None:
    """Make `folder` hold `files` and nothing else."""
    shutil.rmtree(folder)
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)


def judge_cut(bench: Bench, case: Case, before: Files, left: Files) -> None:
    """Hold what a power cut left against what must be: nothing earlier is lost, whatever has a name can be read."""
    for name, data in before.items():
        assert left.get(name) == data or (name in (*case.leaves, *case.may) and left.get(name)), f"{name} is lost"
    new = {name for name, data in left.items() if before.get(name) != data and not Path(name).name.startswith(".")}
    lay_out(bench.folder, left)
    for name in new:
        assert left[name].strip(b"\0"), f"{name} is there without its content"
        check_readable(bench.folder / name, whole=False)


@pytest.mark.parametrize("name", CUT)
def test_a_power_cut_at_every_call_of_every_command(name: str, bench: Bench) -> None:
    case = CASES[name]
    before, journal = bench.fresh(), bench.trace.with_name("journal")
    disk = disk_of(bench.folder)
    ended = bench.run(case, journal=str(journal))
    assert ended.code in (0, 1), ended
    after, cuts = contents(bench.folder), states(disk, journal)
    for words, left in cuts:
        try:
            judge_cut(bench, case, before, left)
        except (AssertionError, pytest.fail.Exception) as wrong:
            raise AssertionError(f"{name}: {words}: {wrong}") from wrong
    _, last = cuts[-1]
    for one in case.leaves:
        assert last.get(one) == after[one], f"{name}: {one} is lost at a power cut after the command has ended"
