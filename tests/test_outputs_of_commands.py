"""Every command that writes: it replaces nothing, never writes into an input, and refuses before it does anything."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import Pans, fixed_run

from pans.app.find_commands import find_commands
from pans.app.main import main
from pans.base import SHIPPED

DEVICE = "sim:oled-qcmos?pace=fast&scene=uniform"
COMMANDS = {  # words, what is there already, what else is read
    "run": ("run b.pans --device sim:oled-qcmos?pace=fast --decisions 3 --record OUT", "OUT", "b.pans"),
    "calibrate": (f"calibrate --device {DEVICE} --seconds 0.5 -o OUT", "OUT", None),
    "bundle": ("bundle --patterns p.npy --table t.npy --classes a,b -o OUT", "OUT", "t.npy"),
    "export csv": ("export r.pansrec --format csv -o DIR", "DIR/clicks.csv", None),
    "export hdf5": ("export r.pansrec --format photon-hdf5 -o OUT", "OUT", "r.pansrec"),
    "export parquet": ("export r.pansrec --format parquet -o OUT", "OUT", "r.pansrec"),
    "export onnx": ("export b.pans --format onnx -o OUT", "OUT", "b.pans"),
    "export npy": ("export b.pans --format npy -o DIR", "DIR/about.json", None),
    "run config": ("run b.pans --device sim:oled-qcmos?pace=fast --write-config OUT", "OUT", None),
    "batch": ("batch info b.pans -o OUT.jsonl", "OUT.jsonl", None),
    "monitoring": ("service monitoring -o DIR", "DIR/grafana-dashboard.json", None),
    "report": ("report b.pans -o OUT", "OUT", "b.pans"),
    "replay": ("replay r.pansrec --pictures OUT", "OUT", "r.pansrec"),
    "compare": ("compare r.pansrec r.pansrec -o OUT", "OUT", "r.pansrec"),
    "profile": ("profile new OUT.toml", "OUT.toml", None),
    "train": ("train fashion-mnist --features 2 --epochs 1 -o OUT", "OUT", None),
    "train checkpoint": ("train fashion-mnist --features 2 --epochs 1 -o OUT", "OUT.checkpoint", None),
    "train history": ("train fashion-mnist --features 2 --epochs 1 -o OUT --history DIR", "DIR/curves.png", None),
    "evaluate": ("evaluate b.pans --pictures DIR", "DIR/confusion.png", None),
    "data": ("data scene cells -o OUT.npz --objects 2", "OUT.npz", None),
    "reproduce json": ("reproduce alpha --collect --cache C -o DIR", "DIR/alpha.json", None),
    "reproduce md": ("reproduce alpha --collect --cache C -o DIR", "DIR/figures.md", None),
    "refit": ("refit b.pans r.pansrec -o OUT", "OUT", "b.pans"),
    "order": ("order b.pans -o OUT", "OUT", "b.pans"),
    "bench": ("bench ingest --quick --plot OUT", "OUT", None),
    "tune": (f"tune b.pans --device {DEVICE} -o OUT", "OUT", "b.pans"),
}
WRITES_NO_FILE = {"verify", "info", "simulate", "instrument", "devices", "doctor", "baseline", "completion", "runs"}
CHECKED_ELSEWHERE = {"demo", "sweep", "conform"}  # tests/runtime/app/run/test_run_files.py, below; conform writes none


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recording: Path) -> Path:
    """A folder with one input of each kind, to work in."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(SHIPPED / "fashion10.pans", "b.pans")
    shutil.copy(recording, "r.pansrec")
    np.save("p.npy", np.ones((2, 4)))
    np.save("t.npy", np.zeros((4, 2)))
    return tmp_path


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "r.pansrec"
    assert main([*fixed_run(3), "--record", str(path)]) == 0
    return path


def contents(folder: Path) -> dict[str, bytes]:
    """Every file of a folder, and every folder in it."""
    return {str(path): path.read_bytes() if path.is_file() else b"" for path in sorted(folder.rglob("*"))}


def refused(words: list[str], folder: Path, why: str, pans: Pans) -> None:
    """Run a command that must be refused for `why`, with a remedy, and leave the folder as it is."""
    if words[0] in ("train", "reproduce", "evaluate"):
        pytest.importorskip("torch", reason="needs the train extra")
    if words[0] in ("bench", "evaluate"):
        pytest.importorskip("matplotlib", reason="needs the plot extra")
    before = contents(folder)
    pans.said()
    said = pans.refuses(*words)
    assert why in said
    assert "remedy: " in said
    assert contents(folder) == before


@pytest.mark.parametrize("name", COMMANDS)
def test_no_command_replaces_a_file(name: str, folder: Path, pans: Pans) -> None:
    words, there, _ = COMMANDS[name]
    Path(there).parent.mkdir(exist_ok=True)
    Path(there).write_bytes(b"precious")
    why = "interrupted" if "checkpoint" in name else "exists already"
    refused(words.split(), folder, why, pans)


@pytest.mark.parametrize("name", [name for name, (_, _, read) in COMMANDS.items() if read])
def test_no_command_writes_into_its_input(name: str, folder: Path, pans: Pans) -> None:
    words, _, read = COMMANDS[name]
    assert read is not None
    Path("OUT").symlink_to(read)
    refused([*words.split(), "--force"], folder, "is the input", pans)


def test_every_command_is_in_one_of_these_lists() -> None:
    known = {words.split()[0] for words, *_ in COMMANDS.values()} | WRITES_NO_FILE | CHECKED_ELSEWHERE
    assert known == {*find_commands()}


def test_a_sweep_appends_to_no_foreign_file(folder: Path, pans: Pans) -> None:
    pytest.importorskip("optuna", reason="needs the sweep extra")
    from pans.base.errors import UsageError
    from pans_trainer.commands.sweep import open_storage

    for text in ("precious\n", "[1]\n", '{"a": 1}\n'):
        Path("journal").write_text(text)
        with pytest.raises(UsageError, match="not a journal"):
            open_storage("journal")
        assert Path("journal").read_text() == text
    open_storage("new-journal")
    open_storage("new-journal")


def test_force_replaces(folder: Path, pans: Pans) -> None:
    for words, there in ((COMMANDS["bundle"][0], "OUT"), (COMMANDS["export csv"][0], "DIR/clicks.csv")):
        Path(there).parent.mkdir(exist_ok=True)
        Path(there).write_bytes(b"old")
        assert main([*words.split(), "--force"]) == 0
        assert Path(there).read_bytes() != b"old"
