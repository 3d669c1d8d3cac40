"""Virtual time: many reads in one call are the reads one by one."""

from __future__ import annotations

from typing import Any

import pytest

from pans.base.errors import LinkError
from pans.live.session import Session
from pans.protocol.links.reader import count_delimiters
from pans_sim.ports.serve import open_sim

URL = "sim:ideal?scene=uniform&pace=fast"


@pytest.mark.parametrize("data", [b"", b"\0", b"abc", b"ab\0c", b"\0\0a\0", bytes(70)])
def test_the_frames_of_a_read_are_its_delimiters(data: bytes) -> None:
    assert count_delimiters(data) == data.count(0)


@pytest.mark.parametrize(
    ("frames", "size", "seconds", "reads"),
    [(3, 1 << 20, 60, 3), (100, 60, 60, 2), (100, 1 << 20, 4, 5), (0, 9, 9, 0)],  # 42 bytes each, the clock 20 ppm fast
)
def test_many_reads_in_one_call_are_those_made_one_by_one(frames: int, size: int, seconds: int, reads: int) -> None:
    found = []
    for at_once in (True, False):
        link: Any = open_sim(URL)
        connection = Session(link)
        connection.handshake()  # STATUS comes once a second from here on
        if not at_once:
            link.reads_ahead = False
        chunks = connection.reader.ahead(1.5, frames, size, link.now_ns() + seconds * 10**9)
        found.append([(arrival_ns, len(data)) for arrival_ns, data in chunks])
    assert found[0] == found[1]
    assert len(found[0]) == reads


def test_what_was_read_before_a_link_failed_is_kept_and_the_next_read_fails_again() -> None:
    link: Any = open_sim(URL + "&faults=disconnect:1s/3s")
    connection = Session(link)
    connection.handshake()
    chunks = connection.reader.ahead(5.0, 100, 1 << 20, link.now_ns() + 60 * 10**9)
    assert chunks
    with pytest.raises(LinkError):
        connection.reader.wait(5.0)
