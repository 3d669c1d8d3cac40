"""The other end of a benchmark's link: a process of its own that prints its device URL. Never part of a run."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

from pans.runtime.errors import LinkError

PATIENCE_S = 20.0


@contextmanager
def other_end(words: list[str]) -> Iterator[str]:
    """Run an instrument or an echo, `words`, in a process of its own; yield its device URL."""
    child = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        url = child.stdout.readline().decode().strip()
        if not url:
            raise LinkError("the other end did not start", remedy="run `pans simulate --profile ideal` to see why")
        yield url
    finally:
        child.stdin.close()
        child.stdout.close()
        child.terminate()
        child.wait(PATIENCE_S)
