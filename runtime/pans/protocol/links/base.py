"""Device URLs -> an open link: bytes in, bytes out, and the clock they are stamped with.

`open_link` returns a `Link` (serial.py, usb.py, or a driver by entry point, see docs/how-to/own-device.md); reader.py reads from any
of them. `TracedLink` keeps a hex trace of another link.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from pans.base.console import load_offered, package_of
from pans.base.errors import LinkError, UsageError, refusing
from pans.base.files import refuse_existing

from .link import MEMBERS, Link, whole_link
from .serial import SerialLink
from .usb import UsbLink


def open_link(url: str) -> Link:
    """Open the device that `url` names: `serial:...`, `usb:...`, or a scheme of the entry points `pans.devices` (`sim:` is one).

    Raises UsageError for a URL that makes no sense and LinkError for a device that cannot be reached.
    """
    scheme, points = checked_scheme(url)
    rest = url.partition(":")[2]
    if scheme in LINKS:
        return LINKS[scheme](rest)
    return _checked_link(points[scheme], url)


# Scheme -> what opens the rest of the URL. The entry points `pans.devices` add to them: sim, simserial and simusb are in pans_sim/ports.
LINKS: dict[str, Callable[[str], Link]] = {
    "serial": lambda rest: SerialLink(rest.removeprefix("//")),
    "usb": UsbLink,
}


def checked_scheme(url: str) -> tuple[str, dict[str, EntryPoint]]:
    """Return the scheme of `url` and the schemes of other packages; UsageError, with the URL that was probably meant, for no device URL."""
    scheme, _, rest = url.partition(":")
    points = {point.name: point for point in entry_points(group="pans.devices")}
    known = sorted({*LINKS, *points})
    if rest and scheme in known:
        return scheme, points
    for pattern, meant in _MEANT:
        if found := pattern.fullmatch(url):
            raise UsageError(f"{url!r} is no device URL", remedy=f"did you mean {found.expand(meant)}?")
    if rest:
        raise UsageError(f"unknown device scheme {scheme!r} in {url!r}", remedy=f"known: {', '.join(known)}")
    raise UsageError(
        f"{url!r} is no device URL", remedy="write scheme:target, for example sim:ideal or serial:/dev/ttyACM0"
    )


_MEANT = (  # what looks like a device, and the URL of it
    (re.compile(r"(?i)com\d+|/dev/.+"), r"serial:\g<0>"),
    (re.compile(r"(?:tcp:|socket:)?(?://)?([\w.-]+:\d{1,5})"), r"serial:socket://\1"),
    (re.compile(r"(?:replay:)?(.+\.pansrec)"), r"`pans replay \1`"),
    (re.compile(r"([\w./-]+\.toml)"), r"sim:\1"),
)


def _checked_link(point: EntryPoint, url: str) -> Link:
    """Open a link of another package; an error that is not one of ours names the package."""
    opener = load_offered(point)
    try:
        link: Link = opener(url)
    except OSError as error:
        raise LinkError(f"{url!r} cannot be opened by {package_of(point)}: {error}") from error
    missing = [name for name in MEMBERS if not hasattr(link, name)]
    if missing:
        raise UsageError(
            f"{package_of(point)} opens {url!r} as {type(link).__name__}, which has no {', '.join(missing)}",
            remedy="see docs/how-to/own-device.md for the members of a link",
        )
    return whole_link(link)


def descriptor_of(link: Link) -> int | None:
    """Return the descriptor behind `link` that compiled code may read and write; None where there is none."""
    found = link.fileno()
    return found if isinstance(found, int) and found >= 0 else None


def link_facts(link: Link) -> dict[str, Any]:
    """Return what a recording should say about the link."""
    return {"name": link.name, "simulated": link.simulated, "virtual_time": link.virtual}


def opened_again(lost: Link, url: str) -> Link:
    """Return the way back to a lost link: its own, else a new one to its URL; LinkError while there is none."""
    found = lost.reopen()
    if found is None:
        lost.close()
        found = open_link(url)
    return found


class TracedLink(Link):
    """A link around `link` that writes every byte of both directions to a text file; at most the last line of it is lost.

    One line per read or write: seconds since the link was opened, `>` to the device or `<` from it, then the bytes in hex.
    """

    def __init__(self, link: Link, path: Path, url: str = "", *, force: bool = False) -> None:
        self._link, self._url = link, url or link.name
        self.trouble = ""  # why the trace ended before the link did
        self._lock = threading.Lock()  # the reader's thread and the loop both write
        self._started_ns = link.now_ns()
        self.name, self.simulated, self.virtual = link.name, link.simulated, link.virtual
        with refusing(f"{path}: the trace cannot be written"):
            try:
                if force:
                    path.unlink(missing_ok=True)
                self._file = open(path, "x", encoding="ascii", buffering=1)  # noqa: SIM115 - closed with the link
            except FileExistsError as error:
                raise refuse_existing(path) from error
        self._note("#", f"{link.name} opened; > to the device, < from it; seconds since then")

    def read(self, timeout_s: float) -> bytes:
        """See `Link.read`."""
        try:
            data = self._link.read(timeout_s)
        except LinkError as error:
            self._note("#", error.message)
            raise
        if data:
            self._note("<", data.hex(" "))
        return data

    def write(self, data: bytes) -> None:
        """See `Link.write`."""
        self._note(">", data.hex(" "))
        self._link.write(data)

    def now_ns(self) -> int:
        """See `Link.now_ns`."""
        return self._link.now_ns()

    def pause(self, seconds: float) -> None:
        """See `Link.pause`."""
        self._link.pause(seconds)

    def reopen(self) -> TracedLink:
        """Open the link again and go on with the same trace."""
        self._note("#", "opened again")
        self._link = opened_again(self._link, self._url)
        return self

    def close(self) -> None:
        """Close the link, then the trace."""
        self._link.close()
        with self._lock:
            self._end()

    def _end(self) -> None:
        try:
            self._file.close()
        except OSError as error:  # what was still to be written
            self.trouble = error.strerror or str(error)

    def _note(self, mark: str, text: str) -> None:
        since_s = (self._link.now_ns() - self._started_ns) / 1e9
        with self._lock:
            if self._file.closed:
                return
            try:
                self._file.write(f"{since_s:.9f} {mark} {text}\n")
            except OSError as error:  # a run does not end because its trace cannot be written
                self.trouble = error.strerror or str(error)
                self._end()
