"""`pans conform`: every rule of the protocol tried on a device over its real link, with a verdict for each.

The options and the page of text; the rules are in pans_sim.conform.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from pans.app.command import Command
from pans.app.run import profile_of
from pans.base.console import emit, say
from pans.base.errors import EXIT_ALERT, EXIT_DEVICE, EXIT_FINE, UsageError
from pans.base.numbers import Range
from pans.instrument.profile import load_profile
from pans.protocol.links import open_link

if TYPE_CHECKING:
    from pans_sim.conform import Finding

DEFAULT_PIXELS = 784  # of a picture of 28 x 28, as the shipped scenes have them
MAX_PIXELS = 1 << 22
VERDICTS = ("kept", "broken", "not tried", "gone")
SHOWN_PIECES = 24
SHOWN_BYTES = 64


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("url", metavar="URL", help="the device, like serial:///dev/ttyACM0 or sim:ideal")
    parser.add_argument("--profile", help="the instrument's hardware profile (of a sim: URL: its own)")
    parser.add_argument(
        "--pixels",
        type=Range(1, MAX_PIXELS, whole=True).option,
        default=DEFAULT_PIXELS,
        metavar="N",
        help=f"pixels of the patterns that are loaded (default {DEFAULT_PIXELS})",
    )
    parser.add_argument(
        "--rule", action="append", default=[], metavar="NUMBER", help="try this rule only; may be given again"
    )
    parser.add_argument(
        "--long", action="store_true", help="also the rules that take minutes: past 65 536 messages, drops and commands"
    )
    parser.add_argument("--bytes", action="store_true", help="show what was sent and received for every rule")


def _run(args: argparse.Namespace) -> int:
    from pans_sim.conform import RULES, conform

    unknown = [number for number in args.rule if number not in RULES]
    if unknown:
        raise UsageError(
            f"no rule {', '.join(unknown)}", remedy="docs/reference/protocol.md, section 12, lists them: 1.1 and so on"
        )
    profile = load_profile(args.profile or profile_of(args.url))
    link = open_link(args.url)
    try:
        findings = conform(link, profile, pixels=args.pixels, only=tuple(args.rule), long=args.long, tell=_tell)
    finally:
        link.close()
    found = {word: [one.number for one in findings if one.verdict == word] for word in VERDICTS}
    emit(args, _payload(args.url, findings, found), _page(findings, found, args.bytes))
    if found["gone"]:
        return EXIT_DEVICE
    return EXIT_ALERT if found["broken"] else EXIT_FINE


def _tell(finding: Finding) -> None:
    if finding.verdict == "broken":
        say(f"rule {finding.number} is broken: {finding.why}")
    elif finding.verdict == "gone":
        say(f"the device went away in rule {finding.number}: {finding.why}")


def _payload(url: str, findings: list[Finding], found: dict[str, list[str]]) -> dict[str, Any]:
    return {
        "device": url,
        "verdict": "FAIL" if found["broken"] or found["gone"] else "PASS",
        "kept": len(found["kept"]),
        "broken": found["broken"],
        "gone": found["gone"][0] if found["gone"] else None,
        "not_tried": len(found["not tried"]),
        "rules": [one.as_json() for one in findings],
    }


def _page(findings: list[Finding], found: dict[str, list[str]], with_bytes: bool) -> str:
    lines = []
    for one in findings:
        lines.append(f"{one.number:>5}  {one.verdict:<9}  {one.words}")
        if one.why:
            lines.append(f"{'':18}{one.why}")
        if with_bytes or one.verdict in ("broken", "gone"):
            lines += [f"{'':18}{piece}" for piece in _pieces(one)]
    kept, broken, rest = (len(found[word]) for word in ("kept", "broken", "not tried"))
    lines.append(f"{kept} rules kept, {broken} broken, {rest} not tried")
    if found["gone"]:
        lines.append(f"the device went away in rule {found['gone'][0]}")
    return "\n".join(lines)


def _pieces(finding: Finding) -> list[str]:
    """The last pieces, in hex: what is broken shows at the end."""
    pieces = finding.pieces[-SHOWN_PIECES:]
    more = len(finding.pieces) - len(pieces)
    lines = [f"({more} earlier pieces)"] if more else []
    for way, data in pieces:
        cut = "" if len(data) <= SHOWN_BYTES else f" ... {len(data)} bytes"
        lines.append(f"{way} {data[:SHOWN_BYTES].hex(' ')}{cut}")
    return lines


CONFORM = Command("try every rule of the protocol on a device, with a verdict for each", _configure, _run)
