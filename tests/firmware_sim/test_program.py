"""When exposures begin: one by one and many at once, up to the end of a 64-bit counter and beyond."""

from __future__ import annotations

import numpy as np

from pans.protocol.wire.commands import SEQUENTIAL
from pans.protocol.wire.schema import LARGEST_TICK
from pans_sim.scene.program import Exposures, Program

LONGEST_CYCLE, MOST_CYCLES = 1 << 48, (1 << 32) - 1  # docs/reference/protocol.md


def exposures(cycle_ticks: int) -> Exposures:
    offsets = np.array([0, 40, 90], np.int64)
    return Exposures(
        Program(SEQUENTIAL, 3, 30, 40, cycle_ticks, 1, offsets, np.arange(3).astype(np.uint16), ((0, 3),)),
        None,
        1_000_000,
    )


def test_one_and_many_agree() -> None:
    times = exposures(200)
    many = times.begins(0, 10_000)
    assert [times.begin(exposure) for exposure in (0, 1, 2, 3, 4095, 4096, 9_999)] == many[
        [0, 1, 2, 3, 4095, 4096, 9_999]
    ].tolist()
    assert many[:5].tolist() == [0, 40, 90, 200, 240]
    assert times.begins(4_000, 200).tolist() == many[4_000:4_200].tolist()


def test_beyond_the_counter() -> None:
    """The next object's mark may lie there, and what is prepared ahead."""
    times = exposures(LONGEST_CYCLE)
    assert times.begin(3 * MOST_CYCLES + 1) == MOST_CYCLES * LONGEST_CYCLE + 40
    ahead = times.begins(3 * (1 << 15) - 9, 9_000)
    assert ahead[:9].tolist() == [times.begin(3 * (1 << 15) - 9 + k) for k in range(9)]
    assert (np.diff(ahead) >= 0).all()
    assert ahead[-1] == LARGEST_TICK
