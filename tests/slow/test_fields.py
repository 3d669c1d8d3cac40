"""Any field of any message holds another value, in whole sessions of every mode; hypothesis chooses which, and what."""

import struct
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mutated_sessions import LAYOUTS, MISSING, STAMP, Mutation, Stage

from pans.protocol.wire.schema import FACTS

pytestmark = pytest.mark.slow

COUNTED = ("COUNTS", STAMP, "READ_COUNTS", "LOAD_COUNT_STATES", "COUNT_STATE")
MODES = {  # and what a session of each has on the wire beside what all have
    "sequential": ("CLICKS", STAMP),
    "parallel": ("FRAMES",),
    "device-driven": ("CLICKS", STAMP, "LOAD_MASKS", "LOAD_STATES", "STATE"),
    "host-driven": ("CLICKS", STAMP, "LOAD_MASKS", "SHOW"),
    "device-driven-counts": COUNTED,
    "device-driven-detectors": COUNTED,
}
TO_DEVICE = ("HELLO", "PING", "COMMAND", "GRANT", "LOAD_PATTERN", "LOAD_PLAN", "PLAN_SLOT", "ARM", "GATE")
FROM_DEVICE = ("WELCOME", "PONG", "ACK", "STATUS", "MARK")
FACT = st.one_of(
    st.just(MISSING), st.none(), st.booleans(), st.integers(-1, (1 << 64) - 1), st.floats(), st.text(max_size=300),
    st.just(b"b"), st.just([]), st.just({"a": [{}]}), st.just("1000000"),
)  # fmt: skip


EDGES = sorted({(1 << power) - less for power in (0, 15, 16, 31, 32, 62, 63, 64) for less in (0, 1)})


def change_of(code: str) -> st.SearchStrategy[dict[str, Any]]:
    """A change of a field with that code: to an edge of its bits or another value, or by a step."""
    if code == "f":
        return st.fixed_dictionaries({"to": st.floats(width=32)})
    values = st.one_of(st.sampled_from(EDGES), st.integers(0, (1 << 8 * struct.calcsize(code)) - 1))
    steps = st.sampled_from((-1, 1, 100, -100, 10**6, 10**9))
    return st.one_of(st.fixed_dictionaries({"to": values}), st.fixed_dictionaries({"by": steps}))


@st.composite
def mutations(draw: st.DrawFn, mode: str) -> Mutation:
    """A mutation of a message that a session in `mode` has."""
    message = draw(st.sampled_from((*FROM_DEVICE, *MODES[mode], *TO_DEVICE)))
    first, most = draw(st.sampled_from((0, 1, 3, 10))), draw(st.sampled_from((1, 3, 1 << 30)))
    if message == "WELCOME" and draw(st.booleans()):
        key = draw(st.sampled_from((*FACTS, "extra")))
        return Mutation(message, f"map.{key}", draw(FACT))
    field = draw(st.sampled_from([one for one in LAYOUTS[message] if one.name != "reserved"]))
    return Mutation(message, field.name, **draw(change_of(field.code)), first=first, most=most)


@pytest.fixture(scope="module")
def stages() -> dict[str, Stage]:
    return {mode: Stage(mode) for mode in MODES}


@pytest.mark.parametrize("mode", MODES)
@settings(max_examples=100, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_any_field_is_taken_or_refused_and_never_passes_against_the_evidence(
    mode: str, stages: dict[str, Stage], tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    chosen = data.draw(st.lists(mutations(mode), min_size=1, max_size=2))
    session = stages[mode].run(tmp_path_factory.mktemp("session"), data.draw(st.integers(0, 1000)), *chosen)
    assert session.wrong == []
