"""Every rule tried on one device, one after another, each in a session of its own.

A broken rule does not keep the next one from being tried. A device that goes away does; what was found before is kept.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from pans.base.errors import LinkError
from pans.instrument.profile import Profile
from pans.protocol.links import Link
from pans.protocol.wire import SCHEMA, Opcode

from . import rules  # noqa: F401  (they register themselves)
from .bench import Bench, Piece
from .registry import RULES, Broken, NotTried, Rule, Silent, in_order

KEPT, BROKEN, NOT_TRIED, GONE = "kept", "broken", "not tried", "gone"
MOST_SILENT = 3  # rules in a row whose session does not open: after that the device is taken as gone
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
    long: bool = False,
    tell: Callable[[Finding], None] = lambda _: None,
) -> list[Finding]:
    """Try all rules (or those in `only`) on the device at the end of `link`, and return what came of each, in order.

    The long rules are tried with `long`, or when `only` names them. When the link breaks, or the device stops answering, the rule in
    which it did is GONE, and those behind it are not tried. LinkError when nothing at all comes from the device.
    """
    bench = Bench(link, profile, pixels)
    try:
        bench.open()
    except Broken as error:
        if not bench.bytes_heard:
            raise LinkError(
                f"{link.name}: {error}", remedy="is it switched on, and does it speak the protocol?"
            ) from None
    findings: list[Finding] = []
    silent: list[int] = []  # places of the latest findings, as far as no session opened for them
    lost = ""
    for number in sorted(only or RULES, key=in_order):
        rule = RULES[number]
        if lost or (rule.long and not (long or only)):
            findings.append(Finding(number, rule.words, NOT_TRIED, lost or "it takes minutes: --long tries it", ()))
            continue
        finding, opened = _tried(bench, rule)
        findings.append(finding)
        tell(finding)
        if rule.check is not None:
            silent = [] if opened else [*silent, len(findings) - 1]
        if len(silent) == MOST_SILENT:
            _name_last_sign(findings, silent[0])
        lost = next((f"the device went away in rule {one.number}" for one in findings if one.verdict == GONE), "")
    return findings


def _name_last_sign(findings: list[Finding], first: int) -> None:
    """Mark the rule in which the device fell silent: the last one with a session if it is broken, else the first one without."""
    at = first - 1 if first > 0 and findings[first - 1].verdict == BROKEN else first
    why = f"{findings[at].why}; the device opens no session any more ({MOST_SILENT} rules tried)"
    findings[at] = findings[at]._replace(verdict=GONE, why=why)
    if first > 0:  # of a device that never opened a session each try says something about the device
        findings[at + 1 :] = [one._replace(verdict=NOT_TRIED) for one in findings[at + 1 :]]


def _tried(bench: Bench, rule: Rule) -> tuple[Finding, bool]:
    """Try one rule; also say whether the device opened a session for it."""
    if rule.check is None:
        return Finding(rule.number, rule.words, NOT_TRIED, rule.why, ()), True
    verdict, why, opened = KEPT, "", False
    bench.pieces.clear()
    damaged = bench.damaged
    try:
        bench.open()
        opened = True
        rule.check(bench)
    except Broken as error:
        verdict, why = BROKEN, str(error)
        opened = opened or not isinstance(error, Silent)
    except NotTried as error:
        verdict, why = NOT_TRIED, str(error)
    except LinkError as error:
        verdict, why = GONE, f"the link broke: {error.message}"
    pieces = tuple(bench.pieces)
    if opened and verdict != GONE and (broke := _leave(bench)):
        verdict, why = GONE, f"{why}; {broke}" if why else broke
    if verdict != KEPT and (count := bench.damaged - damaged):
        why += (
            f"; {count} frame{'s' * (count > 1)} arrived with a wrong CRC: check the CRC's start value, 0 of HELLO and WELCOME and the "
            f"schema hash {SCHEMA:#010x} of all others (protocol, section 1)"
        )
    return Finding(rule.number, rule.words, verdict, why, pieces), opened


def _leave(bench: Bench) -> str:
    """Leave the device dark, and say whether the link broke; a device that does not answer has its lease for that."""
    try:
        bench.done(Opcode.STOP)
    except LinkError as error:
        return f"the link broke at STOP: {error.message}"
    except Broken:
        pass
    return ""
