"""Every rule tried on one device, one after another, each in a session of its own.

Owns the order and the verdicts; a rule that is broken does not keep the next one from being tried.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple

from pans.runtime.errors import LinkError
from pans.runtime.instrument.profile import Profile
from pans.runtime.link.base import Link
from pans.runtime.wire.messages import Opcode

from . import counts, frames, orders, runs, sessions, walks  # noqa: F401  (they register the rules)
from .bench import Bench, Piece
from .rules import RULES, Broken, NotTried, Rule, in_order

KEPT, BROKEN, NOT_TRIED = "kept", "broken", "not tried"
SHOWN_BYTES = 160


class Finding(NamedTuple):
    """What came of one rule; `pieces` are the bytes that went over the link for it."""

    number: str
    words: str
    verdict: str
    why: str
    pieces: tuple[Piece, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the finding with its bytes in hex, each piece cut at SHOWN_BYTES."""
        rows = [[piece.way, len(piece.data), piece.data[:SHOWN_BYTES].hex()] for piece in self.pieces]
        return {"rule": self.number, "words": self.words, "verdict": self.verdict, "why": self.why, "bytes": rows}


def conform(
    link: Link,
    profile: Profile,
    *,
    pixels: int,
    only: tuple[str, ...] = (),
    tell: Callable[[Finding], None] = lambda _: None,
) -> list[Finding]:
    """Try all rules (or those in `only`) on the device at the end of `link`, and return what came of each, in order.

    LinkError when the device does not answer at all, or the link breaks.
    """
    bench = Bench(link, profile, pixels)
    try:
        bench.open()
    except Broken as error:
        raise LinkError(f"{link.name}: {error}", remedy="is it switched on, and does it speak the protocol?") from None
    findings = []
    for number in sorted(only or RULES, key=in_order):
        finding = _tried(bench, RULES[number])
        findings.append(finding)
        tell(finding)
    _leave(bench)
    return findings


def _tried(bench: Bench, rule: Rule) -> Finding:
    if rule.check is None:
        return Finding(rule.number, rule.words, NOT_TRIED, rule.why, ())
    verdict, why = KEPT, ""
    bench.pieces.clear()
    try:
        bench.open()
        rule.check(bench)
    except Broken as error:
        verdict, why = BROKEN, str(error)
    except NotTried as error:
        verdict, why = NOT_TRIED, str(error)
    pieces = tuple(bench.pieces)
    _leave(bench)
    return Finding(rule.number, rule.words, verdict, why, pieces)


def _leave(bench: Bench) -> None:
    """Leave the device dark; a device that does not answer has its lease for that."""
    with suppress(Broken):
        bench.done(Opcode.STOP)
