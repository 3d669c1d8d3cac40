"""A link to an emulated instrument, whose time passes only while the host waits; and how that becomes a device URL."""

from __future__ import annotations

from pathlib import Path

from pans.base.errors import LinkError
from pans.protocol.links import Link


class LockStepLink(Link):
    """A link whose emulator lives on when a run closes it, as hardware does, until `end`; see `Link`."""

    simulated, virtual = False, True

    def __init__(self, name: str) -> None:
        self.name, self.closed, self.at_ns = name, False, 0

    def run(self, until_ns: int) -> bytes:
        """Let time pass up to `until_ns`, or until the instrument has said something, which is returned; set `at_ns`."""
        raise NotImplementedError

    def send(self, data: bytes) -> None:
        """Hand bytes to the instrument's port."""
        raise NotImplementedError

    def end(self) -> None:
        """Switch the emulator off."""
        raise NotImplementedError

    def read(self, timeout_s: float) -> bytes:
        """See `Link`."""
        self._check_open()
        return self.run(self.at_ns + max(0, round(timeout_s * 1e9)))

    def write(self, data: bytes) -> None:
        """See `Link`."""
        self._check_open()
        self.send(bytes(data))

    def now_ns(self) -> int:
        """See `Link`."""
        return self.at_ns

    def pause(self, seconds: float) -> None:
        """Let the instrument's time pass; what it says meanwhile is lost."""
        until = self.at_ns + round(seconds * 1e9)
        while self.at_ns < until:
            self.run(until)

    def reopen(self) -> LockStepLink:
        """Open the port of the same instrument again."""
        self.closed = False
        return self

    def close(self) -> None:
        """See `Link`."""
        self.closed = True

    def _check_open(self) -> None:
        if self.closed:
            raise LinkError(f"{self.name} is closed")


open_links: list[LockStepLink] = []  # that openers have made: the test ends them


def register(folder: Path, scheme: str, opener: str) -> str:
    """Describe a driver as an installed package would; return the folder that belongs into `sys.path`."""
    facts = folder / f"pans_{scheme}-1.dist-info"
    facts.mkdir(parents=True)
    (facts / "METADATA").write_text(f"Metadata-Version: 2.1\nName: pans-{scheme}\nVersion: 1\n")
    (facts / "entry_points.txt").write_text(f"[pans.devices]\n{scheme} = {opener}\n")
    return str(folder)
