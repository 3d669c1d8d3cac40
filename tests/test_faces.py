"""What importing a package loads, and that its public names are not hidden by modules."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from types import ModuleType

import pytest
from tree import ROOT

FACES = sorted(
    f"pans.{path.parent.relative_to(ROOT).as_posix().replace('/', '.')}".replace("pans.runtime.api", "pans")
    for top in ("runtime", "firmware_sim")
    for path in ROOT.glob(f"{top}/*/__init__.py")
)
SLOW_TO_LOAD = ("numba", "onnxruntime", "torch", "matplotlib", "h5py", "scipy", "serial", "usb", "rich")


@pytest.mark.parametrize("package", ["pans", "pans.runtime", "pans.runtime.cli", "pans.firmware_sim"])
def test_what_every_command_loads_is_light(package: str) -> None:
    code = f"import sys, {package}; print(*(name for name in {SLOW_TO_LOAD!r} if name in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize("package", FACES)
def test_a_public_name_is_never_hidden_by_a_module_of_that_name(package: str) -> None:
    face = importlib.import_module(package)
    for name in getattr(face, "__all__", ()):
        if importlib.util.find_spec(f"{face.__name__}.{name}") is not None:
            importlib.import_module(f"{face.__name__}.{name}")
            assert not isinstance(getattr(face, name), ModuleType), name
