"""The most memory that a command takes, in a process of its own (Linux); as a program it is that process."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple


class Peak(NamedTuple):
    """Exit code, the most resident memory in MiB, and what was said on stderr."""

    code: int
    mib: float
    said: str


def peak_of(words: Sequence[str], folder: Path) -> Peak:
    """Run a command of `pans` in `folder`."""
    asked = [sys.executable, __file__, *words]
    done = subprocess.run(asked, cwd=folder, capture_output=True, text=True, timeout=300, check=False)
    code, mib = json.loads(done.stdout.splitlines()[-1])
    return Peak(code, mib, done.stderr)


def _measure(words: list[str]) -> None:
    from pans.runtime.cli import main

    code = main(words)
    status = Path("/proc/self/status").read_text()
    peak_kib = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM"))
    print(json.dumps([code, peak_kib / 1024]))  # ru_maxrss would begin with that of the process that started this one


if __name__ == "__main__":
    _measure(sys.argv[1:])
