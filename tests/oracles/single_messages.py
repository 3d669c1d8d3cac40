"""The slow twin of a replay: the core takes each recorded message by `step`, and no kernel of a call is used."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest

from pans.bundle.sensor import Bundle
from pans.decide.decision import rows_of
from pans.protocol.wire import Arm, unpack_body
from pans.record.reading import Recording
from pans.record.reading.parts import place_of
from pans.record.replay import ClickLog, Replayed, _begun, replay


def decided_one_by_one(core: Any, arms: Mapping[int, Arm], recording: Recording) -> Iterator[np.ndarray]:
    """Yield the decisions of each message, and of each stream that an ARM begins."""
    streams, session = _begun(core, arms, place_of(recording)), 0
    for _, body in recording.messages():
        frame = unpack_body(body)
        while frame.session != session:
            session, rows = next(streams)
            yield rows
        yield rows_of(core.step(frame).decisions)
    yield from (rows for _, rows in streams)


def replay_one_by_one(recording: Recording, bundle: Bundle, log: ClickLog | None = None) -> Replayed:
    """Return what `replay` returns."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pans.record.replay._decided", decided_one_by_one)
        return replay(recording, bundle, log)
