"""What importing a package loads: faces stay light, and the lean half never meets a heavy library."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from types import ModuleType

import pytest
from tree import ROOT

LIGHT = sorted(
    f"pans.{path.parent.relative_to(ROOT).as_posix().replace('/', '.')}"
    for top in ("runtime", "firmware_sim")
    for path in ROOT.glob(f"{top}/*/__init__.py")
)
SLOW_TO_LOAD = ("numba", "onnxruntime", "torch", "matplotlib", "h5py", "serial", "usb", "rich")


@pytest.mark.parametrize("package", [*LIGHT, "pans.runtime.cli", "pans.trainer", "pans.firmware_sim"])
def test_a_face_loads_no_slow_library(package: str) -> None:
    name = "pans" if package == "pans.runtime.api" else package
    code = f"import sys, {name}; print(*(name for name in {SLOW_TO_LOAD!r} if name in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize("package", LIGHT)
def test_a_public_name_is_never_hidden_by_a_module_of_that_name(package: str) -> None:
    face = importlib.import_module("pans" if package == "pans.runtime.api" else package)
    for name in getattr(face, "__all__", ()):
        if importlib.util.find_spec(f"{face.__name__}.{name}") is not None:
            importlib.import_module(f"{face.__name__}.{name}")
            assert not isinstance(getattr(face, name), ModuleType), name
