"""Every command answers a file that an accident or a stranger changed with an exit code of the contract, in little memory.

Few examples of each by default; the long form (`-m slow`) takes 10 000 pictures and 10 000 other files.
"""

import contextlib
import hashlib
import io
import json
import shutil
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import small_files
from changed_files import (
    changed_bundle,
    changed_bytes,
    changed_calibration,
    changed_json,
    changed_recording,
    changed_toml,
    pictures,
)
from heads import affine_head
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from thirds import write_thirds

from pans.app.main import main
from pans.base.files.container import canonical_json
from pans.bundle.sensor import bundle_bytes
from pans.instrument.profile import profile_text
from pans.record.reading import read_recording
from pans_sim.testing import small_automaton_bundle, small_setup

FINE = {0, 1, 2, 3, 4}  # 70 is a fault of pans
MORE_MIB = 300  # than the program takes by itself, which with torch is another 300
TOGETHER = 25  # pictures in one class folder, of which each is named or passed over
FAST = "--device sim:ideal?scene=uniform&pace=fast --decisions 1 --no-realtime"
COMMANDS = {  # what takes a file of each kind
    "b.pans": ("verify {}", "info {}", f"run {{}} {FAST.replace('ideal', 'dmd-spad')} --out new --force"),
    "r.pansrec": ("verify {}", "info {}", "replay {}", "export {} --format csv -o exported --force", "report {} -o new.html --force"),
    "c.json": ("verify {}", "info {}", f"run small.pans {FAST} --out new --force --profile ideal --calibration {{}}"),
    "p.toml": ("verify {}", "profile check {}", "info {}"),
    "s.npz": ("train {} --features 2 --epochs 1 -o new.pans --force", f"run small.pans {FAST.replace('uniform', '{}')} --out new --force"),
    "h.onnx": ("bundle --patterns p.npy --head {} --classes a,b -o new.pans --force",),
    "p.npy": ("bundle --patterns {} --head h.onnx --classes a,b -o new.pans --force",),
    "t.npy": ("bundle --patterns p.npy --table {} --classes a,b -o new.pans --force",),
    "o.toml": ("run --config {} --out new --force",),
    "state.json": (f"run small.pans {FAST} --out new --force --state {{}}",),
    "f.toml": ("run thirds.pans --device sim:flow-snspd?scene=cells.toml&pace=fast --seconds 0.01 --flow {} --out new --force",),
    "cells.toml": ("run thirds.pans --device sim:flow-snspd?pace=fast&scene={} --seconds 0.01 --flow f.toml --out new --force",),
    "summary.json": ("compare {} other",),
    "new/run.pansrec": ("runs .", "compare new other"),
}  # fmt: skip
CHANGES: dict[str, Callable[[bytes], st.SearchStrategy[bytes]]] = {
    ".pans": changed_bundle,
    ".pansrec": changed_recording,
    "c.json": changed_calibration,
    ".toml": changed_toml,
    ".json": lambda data: changed_json(json.loads(data)).map(lambda tree: json.dumps(tree).encode()),
}


@st.composite
def changed_npz(draw: st.DrawFn, data: bytes) -> bytes:
    """An archive with one array changed, in its bytes or as a whole, under right checksums; or with its own bytes changed."""
    if draw(st.integers(0, 3)) == 0:
        return draw(changed_bytes(data))
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as before, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as after:
        chosen = draw(st.sampled_from(before.namelist()))
        for name in before.namelist():
            after.writestr(name, draw(changed_bytes(before.read(name))) if name == chosen else before.read(name))
    return stream.getvalue()


CHANGES[".npz"] = changed_npz


@contextlib.contextmanager
def little_memory() -> Iterator[None]:
    """Demand that the process does not grow by more than MORE_MIB at any time within the block."""

    def status(key: str) -> float:
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(dict(line.split(":", 1) for line in lines)[key].split()[0]) / 1024

    if sys.platform != "linux":
        yield
        return
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # VmHWM begins anew
    before = status("VmRSS")
    yield
    assert status("VmHWM") - before < MORE_MIB


def demand_answer(line: str, path: str, codes: set[int] = FINE) -> None:
    """Run a command line in which {} is the changed file; demand one of the exit codes and no traceback."""
    said, words = io.StringIO(), [word.replace("{}", path) for word in line.split()]
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said), little_memory():
        try:
            code = main(words)
        except SystemExit as end:
            code = int(end.code or 0)
    assert code in codes, f"{line}: {said.getvalue()}"
    assert "Traceback" not in said.getvalue()


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a sound file of each kind, and what the commands need beside it."""
    folder = tmp_path_factory.mktemp("sound")
    write_thirds(folder)
    (folder / "f.toml").write_bytes((folder / "flow.toml").read_bytes())
    (folder / "small.pans").write_bytes(bundle_bytes(small_setup()[1]))
    (folder / "b.pans").write_bytes(bundle_bytes(small_automaton_bundle()))
    (folder / "r.pansrec").write_bytes(small_files.record_run(tmp_path_factory.mktemp("run")).read_bytes())
    calibration = json.loads(small_files.small_calibration(folder))
    calibration["device"]["serial"] = "SIM-00000000"  # that of seed 0
    calibration["sha256"] = hashlib.sha256(
        canonical_json({k: v for k, v in calibration.items() if k != "sha256"})
    ).hexdigest()
    (folder / "c.json").write_text(json.dumps(calibration))
    (folder / "p.toml").write_text(profile_text("dmd-spad"))
    rng = np.random.default_rng(0)
    images, labels = rng.integers(0, 255, (240, 2, 2), np.uint8), np.arange(240) % 3
    np.savez(folder / "s.npz", images=images, labels=labels, classes=np.array(["a", "b", "c"]))
    np.save(folder / "p.npy", rng.random((3, 4)))
    np.save(folder / "t.npy", rng.normal(size=(8, 2)))
    (folder / "h.onnx").write_bytes(affine_head(rng.normal(size=(3, 2)).astype(np.float32), np.zeros(2, np.float32)))
    (folder / "o.toml").write_text(
        'bundle = "small.pans"\ndevice = "sim:ideal?scene=uniform&pace=fast"\ndecisions = 1\nrealtime = false\n'
    )
    with contextlib.chdir(folder):
        for out in ("new", "other"):
            demand_answer(f"run small.pans {FAST} --out {out} --state state.json", "", {0})
        (folder / "summary.json").write_text(json.dumps(dict(read_recording("new/run.pansrec").summary)))
    return folder


@pytest.fixture(scope="module")
def sound_pictures() -> dict[str, bytes]:
    pytest.importorskip("PIL")
    return pictures()


def check_file(sound: Path, name: str, data: st.DataObject) -> None:
    """Let each command that takes it answer one changed file."""
    suffix = next(suffix for suffix in (*CHANGES, "") if name.endswith(suffix))
    whole = (sound / name).read_bytes()
    changed = data.draw(CHANGES.get(suffix, changed_bytes)(whole))
    path = name if "/" in name else f"changed{Path(name).suffix}"
    with contextlib.chdir(sound):
        Path(path).write_bytes(changed)
        try:
            for line in COMMANDS[name]:
                demand_answer(line, path)
        finally:
            (sound / name).write_bytes(whole)


def check_pictures(folder: Path, sound: dict[str, bytes], data: st.DataObject) -> None:
    """Let a class folder of changed pictures of all formats be read, each under a name of ours."""
    shutil.rmtree(folder / "set", ignore_errors=True)
    for name in ("a", "b"):
        (folder / "set" / name).mkdir(parents=True)
    (folder / "set" / "b" / "sound.png").write_bytes(sound["PNG-L-0"])
    for number in range(TOGETHER):
        changed = data.draw(changed_bytes(sound[data.draw(st.sampled_from(sorted(sound)))]))
        (folder / "set" / "a" / f"{number}.png").write_bytes(changed)
    with contextlib.chdir(folder):  # class b has too few images: nothing is trained
        demand_answer("train set --features 2 --skip-bad -o new.pans", "", {2})


def case(examples: int) -> settings:
    few = (Phase.generate,)  # a failure is shown as it was found: to shrink one takes thousands of commands
    checks = [*HealthCheck]
    return settings(max_examples=examples, deadline=None, derandomize=True, phases=few, suppress_health_check=checks)


@pytest.mark.parametrize("name", COMMANDS)
def test_the_sound_file_is_used(name: str, sound: Path) -> None:
    """Otherwise the commands would refuse a changed one for another reason, and nothing of it would be tried."""
    path = name if "/" in name else f"changed{Path(name).suffix}"
    with contextlib.chdir(sound):
        Path(path).write_bytes((sound / name).read_bytes())
        for line in COMMANDS[name]:
            demand_answer(line, path, {0, 1})


@pytest.mark.parametrize("name", COMMANDS)
@case(4)
@given(data=st.data())
def test_a_changed_file_is_answered(name: str, sound: Path, data: st.DataObject) -> None:
    check_file(sound, name, data)


@case(8)
@given(data=st.data())
def test_changed_pictures_are_answered(
    tmp_path_factory: pytest.TempPathFactory, sound_pictures: dict[str, bytes], data: st.DataObject
) -> None:
    check_pictures(tmp_path_factory.getbasetemp(), sound_pictures, data)


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
@case(770)
@given(data=st.data())
def test_thousands_of_changed_files_are_answered(name: str, sound: Path, data: st.DataObject) -> None:
    check_file(sound, name, data)


@pytest.mark.slow
@case(10_000 // TOGETHER)
@given(data=st.data())
def test_ten_thousand_changed_pictures_are_answered(
    tmp_path_factory: pytest.TempPathFactory, sound_pictures: dict[str, bytes], data: st.DataObject
) -> None:
    check_pictures(tmp_path_factory.getbasetemp(), sound_pictures, data)
