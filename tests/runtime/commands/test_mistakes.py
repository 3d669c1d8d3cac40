"""Mistakes of users, such as files of a wrong kind, folders for files, wrong units: the contract's exit code, and what was found."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import fixed_run

from pans.runtime import SHIPPED
from pans.runtime.cli import main
from pans.runtime.instrument.calibration import sealed
from pans.runtime.instrument.profile import profile_text
from pans.runtime.record import Recorder

RUN = fixed_run(1)  # a run that is right, but for what is added
TO = "run fashion10 --decisions 1 --device "


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mistakes")
    with Recorder(folder / "run.pansrec", {"simulated": True}) as recorder:
        recorder.close({})
    (folder / "lab.toml").write_text(profile_text("oled-qcmos"))
    (folder / "cal.json").write_bytes(sealed({"what": 1}, "calibration"))
    (folder / "notes.txt").write_text("hello\n")
    (folder / "options.toml").write_text("decisions = 3\n")
    (folder / "folder").mkdir()
    shutil.copy(SHIPPED / "fashion10.pans", folder / "some.pans")
    np.savez(folder / "good.npz", images=np.zeros((5, 4, 4), np.uint8), labels=np.arange(5))
    return folder


MISTAKES: list[tuple[str, str]] = [  # the words, and what is said
    # files of another kind
    ("run run.pansrec --device sim:oled-qcmos", "not a PANS bundle: it is a recording|`pans replay`"),
    ("run lab.toml --device sim:oled-qcmos", "not a PANS bundle: it is a hardware profile|--profile"),
    ("run good.npz --device sim:oled-qcmos", "not a PANS bundle: it is a .npz archive|?scene=FILE"),
    ("run cal.json --device sim:oled-qcmos", "not a PANS bundle: it is a calibration|--calibration"),
    ("run folder --device sim:oled-qcmos", "it is a folder|name a file"),
    ("replay some.pans", "not a recording: it is a bundle|`pans run"),
    ("replay lab.toml", "not a recording: it is a hardware profile|--profile"),
    ("info notes.txt", "is no file of this project|bundles (.pans)"),
    ("RUN --calibration lab.toml", "lab.toml: not a calibration: it is a hardware profile|--profile"),
    ("RUN --calibration options.toml", "options.toml: not a calibration: it is TOML text|--config"),
    ("RUN --registration cal.json", "not a registration: it is a calibration|--calibration"),
    ("RUN --profile cal.json", "not a hardware profile: it is a calibration|--calibration"),
    ("RUN --flow lab.toml", "not the settings of a flow: it is a hardware profile|--profile"),
    ("RUN --config lab.toml", "not a file of options: it is a hardware profile|--write-config"),
    ("service show --config some.pans", "not a file of options: it is a bundle|--write-config"),
    ("demo --profile some.pans", "not a hardware profile: it is a bundle|`pans run"),
    ("bundle --patterns notes.txt --head notes.txt --classes a,b -o new.pans", "not a readable .npy array|numpy.save"),
    ("verify folder", "no parts of a recording are here|run-0001"),
    # devices without a scheme
    (f"{TO}COM3", "'COM3' is no device URL|did you mean serial:COM3?"),
    (f"{TO}/dev/ttyUSB0", "is no device URL|did you mean serial:/dev/ttyUSB0?"),
    (f"{TO}192.168.1.3:4000", "is no device URL|did you mean serial:socket://192.168.1.3:4000?"),
    (f"{TO}tcp:localhost:4000 --profile oled-qcmos", "is no device URL|serial:socket://localhost:4000?"),
    (f"{TO}run.pansrec", "is no device URL|`pans replay run.pansrec`"),
    (f"{TO}lab.toml", "is no device URL|did you mean sim:lab.toml?"),
    (f"{TO}some:thing", "unknown device scheme 'some'|known: serial, sim"),
    ("demo --seconds 5ms", "'5ms' is not a number|pans help demo"),
]


@pytest.mark.parametrize(("words", "said"), MISTAKES, ids=[words for words, _ in MISTAKES])
def test_a_mistake_is_told(
    words: str, said: str, place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(place)
    before = {path.name for path in place.iterdir()}
    first, *rest = words.split()
    asked = [*(RUN if first == "RUN" else [first]), *rest, "--json"]
    try:
        code = main(asked)
    except SystemExit as ended:  # the parser's
        code = ended.code  # type: ignore[assignment]
    error = json.loads(capsys.readouterr().out)["error"]
    message, _, remedy = said.partition("|")
    assert (code, error["exit"]) == (2, 2), error
    assert message in error["message"]
    assert remedy in error["remedy"]
    assert error["remedy"]
    assert {path.name for path in place.iterdir()} - {"pans-runs"} == before


def test_the_main_error_comes_before_that_of_the_device(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "fashion10", "--device", "COM3", "--profile", "ideal", "--decisions", "1"]) == 2
    told = capsys.readouterr().err
    assert 0 <= told.index("124 levels") < told.index("besides, the device could not be opened: 'COM3' is no")
