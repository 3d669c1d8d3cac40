"""Without any of the extras: every command that needs one says which, with the pip command, and touches nothing."""

import json
import subprocess
import sys

import numpy as np
import pytest
from commands import fixed_run

from pans.app.main import main
from pans.base.console.extras import install

BLOCKED = (
    "torch",
    "onnx",
    "PIL",
    "optuna",
    "matplotlib",
    "jinja2",
    "sklearn",
    "h5py",
    "pyarrow",
    "prometheus_client",
    "ALP4",
    "bokeh",
)
NEEDS = {  # command line: what it needs, and the extra that has it
    "train s.npz --features 2 -o new.pans": ("torch", "train"),
    "train s.npz --encoder automaton --photons 3 -o new.pans": ("torch", "train"),
    "sweep s.npz --features 2 --storage new.log": ("optuna", "train,sweep"),
    "baseline direct --task s.npz --method cnn": ("torch", "train"),
    "reproduce alpha --collect --cache new -o out": ("torch", "train"),
    "export r.pansrec --format photon-hdf5 -o new.h5": ("h5py", "export"),
    "run fashion10 --device sim:ideal?pace=fast --decisions 3 --metrics 0 --out new": ("prometheus-client", "metrics"),
    "run fashion10 --device sim:ideal?pace=fast --decisions 3 --serve 0 --out new": ("bokeh", "ui"),
    "instrument --projector alp --counter tagger --profile alp-tagger": ("ALP4", "alp"),
    "bench decide --quick --plot new.png": ("matplotlib", "plot"),
    "report r.pansrec -o new.html": ("matplotlib", "plot"),
    "compare r.pansrec r.pansrec -o new.html": ("matplotlib", "plot"),
    "export r.pansrec --format parquet -o new.parquet": ("pyarrow", "parquet"),
    "evaluate fashion10 --task s.npz --objects 2 --pictures new": ("matplotlib", "plot"),
}
WORK_WITHOUT = (
    "",
    "help run",
    "profile list",
    "verify r.pansrec",
    "info fashion10",
    "replay r.pansrec",
    "compare r.pansrec r.pansrec",
)
WORK_WITHOUT += ("evaluate fashion10 --task s.npz",)
CHILD = """
import contextlib, io, json, sys

sys.modules |= dict.fromkeys(json.loads(sys.argv[1]))  # None: cannot be imported
from pans.app.main import main
from pans.base.console import install

found = {}
for line in json.loads(sys.argv[2]):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(line.split())
        except SystemExit as end:
            code = int(end.code or 0)
    found[line] = [code, err.getvalue()]
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[int, str]]:
    """Exit code and stderr of every line, in one process without the extras; its folder must not change."""
    folder = tmp_path_factory.mktemp("lean")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main([*fixed_run(3), "--record", "r.pansrec", "-q"]) == 0
    images = np.random.default_rng(0).integers(0, 255, (200, 28, 28)).astype(np.uint8)
    names = ["T-shirt/top", "Trouser", "Pullover", "Dress", "Coat", "Sandal", "Shirt", "Sneaker", "Bag", "Ankle boot"]
    np.savez(folder / "s.npz", images=images, labels=np.arange(200) % 10, classes=np.array(names))
    before = sorted(folder.rglob("*"))
    words = [sys.executable, "-c", CHILD, json.dumps(BLOCKED), json.dumps([*NEEDS, *WORK_WITHOUT])]
    done = subprocess.run(words, capture_output=True, text=True, cwd=folder, check=True)
    assert sorted(folder.rglob("*")) == before
    return {line: (code, err) for line, (code, err) in json.loads(done.stdout.splitlines()[-1]).items()}


@pytest.mark.parametrize("line", NEEDS)
def test_the_extra_is_named(line: str, found: dict[str, tuple[int, str]]) -> None:
    (code, err), (package, extra) = found[line], NEEDS[line]
    assert code == 2, err
    assert package in err
    assert f"remedy: {install(extra)}" in err


@pytest.mark.parametrize("line", WORK_WITHOUT)
def test_the_rest_works_without(line: str, found: dict[str, tuple[int, str]]) -> None:
    code, err = found[line]
    assert code == 0, err
