"""Counts of the kernel for one thread: what it touches is counted, what others touch is not."""

from __future__ import annotations

import mmap
import resource
import subprocess
import sys
import threading

import pytest

from pans.runtime.timing.page_faults import ThreadCounts, fault_words

pytestmark = pytest.mark.skipif(not hasattr(resource, "RUSAGE_THREAD"), reason="only Linux counts by thread")
PAGES = 256


def touch(pages: int) -> None:
    with mmap.mmap(-1, pages * mmap.PAGESIZE) as memory:
        if hasattr(mmap, "MADV_NOHUGEPAGE"):
            memory.madvise(mmap.MADV_NOHUGEPAGE)  # else one fault brings many pages
        for page in range(pages):
            memory[page * mmap.PAGESIZE] = 1


def test_each_page_that_is_touched_first_is_a_minor_fault() -> None:
    counts = ThreadCounts()
    touch(PAGES)
    assert counts.since()["minor"] >= PAGES
    counts.restart()
    assert counts.since()["minor"] < PAGES


def test_pages_that_another_thread_touches_are_not_counted() -> None:
    counts = ThreadCounts()
    thread = threading.Thread(target=touch, args=(PAGES,))
    thread.start()
    thread.join()
    assert counts.since()["minor"] < PAGES


def test_words_say_when_the_system_does_not_tell() -> None:
    assert fault_words({}) == "not told by this system"
    assert fault_words({"minor": 2, "major": 1, "involuntary_switches": 0}).startswith("2 minor, 1 major")


ALLOCATE = """
from pans.runtime.timing.page_faults import ThreadCounts, held_heap
def allocate():
    counts = ThreadCounts()
    for size in range(1, 5):
        b"x" * (size << 20)
    return counts.since()["minor"]
print(allocate())
with held_heap() as answer:
    print(allocate())
print(answer)
"""


def test_a_held_heap_has_been_touched_before() -> None:
    """In a process of its own: what others have left in the heap would have been touched."""
    said = subprocess.run([sys.executable, "-c", ALLOCATE], capture_output=True, text=True, check=True).stdout.split()
    if said[2:] != ["granted"]:
        pytest.skip(" ".join(said[2:]))
    as_it_comes, held = map(int, said[:2])
    assert as_it_comes > (4 << 20) // mmap.PAGESIZE
    assert held < 32
