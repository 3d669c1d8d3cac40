"""`pans conform`: every rule of the protocol tried on a device over its real link, with a verdict for each.

Owns the command's options and its page of text; the rules are pans.firmware_sim.conform's.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from pans.runtime.cli import EXIT_ALERT, EXIT_FINE, Command, emit, say
from pans.runtime.commands.run import profile_of
from pans.runtime.errors import UsageError
from pans.runtime.instrument.profile import load_profile
from pans.runtime.link.base import open_link
from pans.runtime.ranges import Range

if TYPE_CHECKING:
    from pans.firmware_sim.conform import Finding

DEFAULT_PIXELS = 784  # of a picture of 28 x 28, as the shipped scenes have them
MAX_PIXELS = 1 << 22
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
    parser.add_argument("--bytes", action="store_true", help="show what was sent and received for every rule")


def _run(args: argparse.Namespace) -> int:
    from pans.firmware_sim.conform import RULES, conform

    unknown = [number for number in args.rule if number not in RULES]
    if unknown:
        raise UsageError(
            f"no rule {', '.join(unknown)}", remedy="docs/reference/protocol.md, section 12, lists them: 1.1 and so on"
        )
    profile = load_profile(args.profile or profile_of(args.url))
    link = open_link(args.url)
    try:
        findings = conform(link, profile, pixels=args.pixels, only=tuple(args.rule), tell=_tell)
    finally:
        link.close()
    broken = [one.number for one in findings if one.verdict == "broken"]
    emit(args, _payload(args.url, findings, broken), _page(findings, args.bytes))
    return EXIT_ALERT if broken else EXIT_FINE


def _tell(finding: Finding) -> None:
    if finding.verdict == "broken":
        say(f"rule {finding.number} is broken: {finding.why}")


def _payload(url: str, findings: list[Finding], broken: list[str]) -> dict[str, Any]:
    counts = {word: sum(one.verdict == word for one in findings) for word in ("kept", "broken", "not tried")}
    return {
        "device": url,
        "verdict": "FAIL" if broken else "PASS",
        "kept": counts["kept"],
        "broken": broken,
        "not_tried": counts["not tried"],
        "rules": [one.as_json() for one in findings],
    }


def _page(findings: list[Finding], with_bytes: bool) -> str:
    lines = []
    for one in findings:
        lines.append(f"{one.number:>5}  {one.verdict:<9}  {one.words}")
        if one.why:
            lines.append(f"{'':18}{one.why}")
        if with_bytes or one.verdict == "broken":
            lines += [f"{'':18}{piece}" for piece in _pieces(one)]
    kept, broken = (sum(one.verdict == word for one in findings) for word in ("kept", "broken"))
    rest = len(findings) - kept - broken
    return "\n".join([*lines, f"{kept} rules kept, {broken} broken, {rest} not tried"])


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
