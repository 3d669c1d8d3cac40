"""The firmware of rp2040/ in an emulated Pico (rp2040js): how it is built, and a link to it in virtual time.

It needs three things that are not installed with the package: PICO_SDK_PATH, the vendor's SDK (with its TinyUSB, or PICO_TINYUSB_PATH);
PANS_RP2040JS, the folder of the npm package rp2040js 1.4; PANS_RP2040_BOOTROM, its source's demo/bootrom.ts.
"""

from __future__ import annotations

import json
import os
import shutil
import struct
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
from lock_step import LockStepLink, open_links
from qemu_link import FOLDER

from pans.base.errors import LinkError

BENCH = Path(__file__).parent / "rp2040" / "bench.mjs"
NEEDED = ("PICO_SDK_PATH", "PANS_RP2040JS", "PANS_RP2040_BOOTROM")
START_S, BRANCH_TO_ITSELF = 3, 0xE7FE
WALK_SLOTS, PEAK_HZ, DARK_HZ = 33, 2000, 100  # of the shipped automaton, and of the profile dmd-spad


def missing() -> str:
    """Return what is missing, "" if nothing."""
    programs = [name for name in ("arm-none-eabi-gcc", "cmake", "node") if shutil.which(name) is None]
    return ", ".join([name for name in NEEDED if not os.environ.get(name)] + programs)


def build(folder: Path, *words: str) -> str:
    """Build pans.bin and pans.elf in the folder, with more words for cmake; return what the compiler said."""
    source = ["cmake", "-S", str(FOLDER / "rp2040"), "-B", str(folder), "-DPICO_NO_PICOTOOL=1"]
    subprocess.run([*source, *words], check=True, capture_output=True, timeout=300)
    done = subprocess.run(["cmake", "--build", str(folder)], check=True, capture_output=True, text=True, timeout=900)
    return done.stdout + done.stderr


def symbols(image: Path) -> dict[str, int]:
    """Return the addresses of an ELF file's symbols."""
    said = subprocess.run(["arm-none-eabi-nm", str(image)], check=True, capture_output=True, text=True).stdout
    return {words[2]: int(words[0], 16) for words in map(str.split, said.splitlines()) if len(words) == 3}


def write_scene(path: Path) -> Path:
    """Write the shipped images for the bench."""
    scene = np.load(FOLDER.parent / "scenes" / "fashion200.npz")
    images = scene["images"].reshape(len(scene["labels"]), -1)
    head = struct.pack("<5I", *images.shape, WALK_SLOTS, 1000 * PEAK_HZ, 1000 * DARK_HZ)
    path.write_bytes(head + images.astype(np.uint8).tobytes())
    return path


class Rp2040Link(LockStepLink):
    """A link to USB CDC of the emulated chip."""

    def __init__(self, image: Path) -> None:
        super().__init__(f"rp2040:{image}")
        library, rom = (os.environ[name] for name in NEEDED[1:])
        words = ["node", str(BENCH), library, rom, str(image), str(write_scene(image.with_suffix(".scene")))]
        self.sent, self.heard = bytearray(), bytearray()
        self._node = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.reopen()

    def run(self, until_ns: int) -> bytes:
        """See `LockStepLink`; a chip that restarts is gone from the bus."""
        data, there = self._run(until_ns)
        if not there:
            self.closed = True
            raise LinkError(f"{self.name} has left the bus")
        return data

    def reopen(self) -> Rp2040Link:
        """Wait until the chip is on the bus, then open its port."""
        until = self.at_ns + round(START_S * 1e9)
        while not self._run(until)[1]:
            if self.at_ns >= until:
                raise LinkError(f"{self.name} is not on the bus")
        self._run(self.at_ns + 5_000_000)
        self.closed = False
        return self

    def hang(self, exposures: int, at: int) -> None:
        """Let the processor run in a circle at an address in RAM, once so many exposures more have begun."""
        self._ask(b"H" + struct.pack("<IIH", exposures, at & ~1, BRANCH_TO_ITSELF))

    def _run(self, until_ns: int) -> tuple[bytes, bool]:
        self._ask(b"R" + struct.pack("<Q", until_ns))
        self.at_ns, there, count = struct.unpack("<QBI", self._take(13))
        data = self._take(count)
        self.heard += data
        return data, bool(there)

    def send(self, data: bytes) -> None:
        """See `LockStepLink`."""
        self.sent += data
        self._ask(b"W" + struct.pack("<I", len(data)) + data)

    def log(self) -> dict[str, Any]:
        """Return what the bench has seen: `edges` (light, gate, pulse, output or watchdog; 0 or 1; ns), `starts` of the chip, `clk_sys`."""
        self._ask(b"L")
        found: dict[str, Any] = json.loads(self._take(struct.unpack("<I", self._take(4))[0]))
        return found

    def end(self) -> None:
        """See `LockStepLink`."""
        self._node.kill()
        self._node.communicate()

    def _ask(self, words: bytes) -> None:
        assert self._node.stdin is not None
        try:
            self._node.stdin.write(words)
            self._node.stdin.flush()
        except OSError as error:
            raise LinkError(f"{self.name} went away") from error

    def _take(self, count: int) -> bytes:
        assert self._node.stdout is not None
        data = self._node.stdout.read(count)
        if len(data) < count:
            raise LinkError(f"{self.name} went away")
        return data


def open_rp2040(url: str) -> Any:
    """Open `rp2040:IMAGE.bin` (an entry point of `pans.devices`)."""
    open_links.append(Rp2040Link(Path(url.partition(":")[2])))
    return open_links[-1]
