"""What all tests share: fixtures, markers, and what is skipped here and why."""

import gc
import os
import signal
import stat
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import hypothesis
import pytest
from commands import Pans
from tree import ROOT

# these packages need the extra `train`
TRAINER = ("adaptive", "baselines", "choose", "commands", "export", "model", "reproduce", "train", "test_processor.py")
collect_ignore = [] if find_spec("torch") else [f"trainer/{name}" for name in TRAINER]
FREEZE, UNFREEZE = gc.freeze, gc.unfreeze
UNCOMPILED = os.environ.get("NUMBA_DISABLE_JIT") == "1"
# `python -m pytest` puts the checkout on the path, and then `import runtime` would make a second copy of every class.
sys.path[:] = [entry for entry in sys.path if Path(entry or ".").resolve() != ROOT]


# A busy machine makes an example slow, not wrong.
hypothesis.settings.register_profile("pans", parent=hypothesis.settings.default, deadline=None)
hypothesis.settings.load_profile("pans")


def pytest_configure(config: pytest.Config) -> None:
    # A shell that starts the tests in the background lets them ignore Ctrl-C, and so every process that they start.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for name in ("freeze", "unfreeze"):
        pytest.MonkeyPatch().setattr(gc, name, lambda: None)


def pytest_runtest_setup(item: pytest.Item) -> None:
    # A run collects garbage before it is armed: let it look at what its test made, not at torch and 4000 tests.
    gc.collect()
    FREEZE()


@pytest.fixture
def freezing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run freezes and unfreezes, as in any other process."""
    monkeypatch.setattr(gc, "freeze", FREEZE)
    monkeypatch.setattr(gc, "unfreeze", UNFREEZE)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if UNCOMPILED:
        left_out = [item for item in items if not _runs_uncompiled(item)]
        items[:] = [item for item in items if _runs_uncompiled(item)]
        config.hook.pytest_deselected(items=left_out)
    if not os.environ.get("PANS_DATA"):
        reason = "needs the IDX data sets: set PANS_DATA to the folder that holds mnist/ and fashion-mnist/"
        for item in items:
            if "data" in item.keywords:
                item.add_marker(pytest.mark.skip(reason=reason))


def _runs_uncompiled(item: pytest.Item) -> bool:
    """A test marked `uncompiled("a", "b")` runs without the compiler in its cases a and b, or in all of them."""
    mark = item.get_closest_marker("uncompiled")
    if mark is None:
        return False
    call = getattr(item, "callspec", None)
    return not mark.args or (call is not None and call.id in mark.args)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    return Path(os.environ["PANS_DATA"])


@pytest.fixture
def synced(monkeypatch: pytest.MonkeyPatch) -> dict[int, Any]:
    """What survives a power cut, by inode: the size of each file and the names in each folder when it was last synced."""
    found: dict[int, Any] = {}
    fsync = os.fsync

    def note(handle: int) -> None:
        fsync(handle)
        facts = os.fstat(handle)
        found[facts.st_ino] = set(os.listdir(handle)) if stat.S_ISDIR(facts.st_mode) else facts.st_size

    monkeypatch.setattr(os, "fsync", note)
    return found


@pytest.fixture
def pans(capsys: pytest.CaptureFixture[str]) -> Pans:
    return Pans(capsys)


@pytest.fixture(scope="module")
def flow_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with cells.toml, flow.toml and thirds.pans (see thirds.py)."""
    from thirds import write_thirds

    return write_thirds(tmp_path_factory.mktemp("flow"))
