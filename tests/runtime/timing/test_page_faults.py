"""Counts of the kernel for one thread: what it touches is counted, what others touch is not."""

from __future__ import annotations

import mmap
import resource
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
