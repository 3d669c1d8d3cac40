"""Kernels give the same results as plain Python: the tests marked `uncompiled` run once more without the compiler."""

import os
import re
import subprocess
import sys

import pytest
from tree import ROOT


@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="this is the run without the compiler")
def test_kernels_without_the_compiler() -> None:
    marked = [path for path in ROOT.glob("tests/*/**/test_*.py") if "pytest.mark.uncompiled" in path.read_text()]
    wanted = sum(len(re.findall(r"@pytest\.mark\.uncompiled", path.read_text())) for path in marked)
    words = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-rA", *map(str, marked)]
    env = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(words, cwd=ROOT, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    ran = {line.split()[1].partition("[")[0] for line in done.stdout.splitlines() if line.startswith("PASSED ")}
    assert len(ran) == wanted > 0, ran
