"""The reference firmware as an Arm image in QEMU: how it is built, a link to it in virtual time, and the log of a run without a host.

The board is firmware_sim/reference/mps2. With mailbox.c it runs in lock-step: its time stands still while the host works, so that nothing
depends on how busy the machine is. `open_qemu` opens `qemu:IMAGE.elf`.
"""

from __future__ import annotations

import math
import mmap
import os
import shutil
import struct
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from lock_step import LockStepLink, open_links

from pans.firmware_sim import device
from pans.runtime.errors import LinkError

FOLDER = Path(device.__file__).parents[1] / "reference"
COMPILER, QEMU = "arm-none-eabi-gcc", "qemu-system-arm"
CPUS = {"m0plus": "-mcpu=cortex-m0plus", "m4": "-mcpu=cortex-m4"}
STRICT = ("-std=gnu11", "-O2", "-mthumb", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror")
LINKING = ("-nostartfiles", "-ffunction-sections", "-specs=nano.specs", "-specs=nosys.specs", "-Wl,--gc-sections")
SHIFT = 4  # QEMU counts 2^SHIFT ns an instruction: a processor of 62.5 million a second
TICK_HZ = 25_000_000
MAIL_RING, MAIL_AT = 1 << 20, 0xC00000
GO, DONE, IN_PUT, IN_GOT, OUT_PUT, OUT_GOT, UNTIL, NOW, IN = 0, 4, 8, 12, 16, 20, 24, 32, 40
OUT = IN + MAIL_RING
START_S = 20.0


def missing() -> str:
    """Return which program is not installed, "" if none."""
    return next((name for name in (COMPILER, QEMU) if shutil.which(name) is None), "")


def instructions(ticks: int) -> int:
    """How many instructions the emulated processor carries out in so many ticks, rounded up."""
    return math.ceil(ticks * 10**9 / TICK_HZ / 2**SHIFT)


def build(folder: Path, cpu: str, line: str, *defines: str) -> Path:
    """Compile the board with the core for `cpu` and the line `canned` or `mailbox`; warnings are errors."""
    image = folder / f"{'-'.join((line, cpu, *defines))}.elf"
    board = [FOLDER / "mps2" / name for name in ("start.c", "board.c", f"{line}.c")]
    if line == "mailbox":
        (folder / "scene.h").write_text(_scene())
        board.append(FOLDER / "mps2" / "light.c")
    words = [COMPILER, *STRICT, CPUS[cpu], *(f"-D{name}" for name in defines), f"-I{folder}", *LINKING]
    words += ["-T", FOLDER / "mps2" / "mps2.ld", *board, *sorted(FOLDER.glob("*.c")), "-o", image]
    subprocess.run([*map(str, words)], check=True, timeout=120)
    return image


def _scene() -> str:
    scene = np.load(FOLDER.parent / "scenes" / "fashion200.npz")
    images, labels = scene["images"].reshape(len(scene["labels"]), -1), scene["labels"]
    click = ",".join(f"{int(2**32 * -math.expm1(-k / 64))}u" for k in range(1025))
    rows = ",\n".join("{" + ",".join(map(str, row)) + "}" for row in images.tolist())
    return (
        f"enum {{ OBJECTS = {len(images)}, PIXELS = {images.shape[1]} }};\n"
        f"static const uint8_t CLASS[OBJECTS] = {{{','.join(map(str, labels.tolist()))}}};\n"
        f"static const uint8_t IMAGE[OBJECTS][PIXELS] = {{{rows}}};\n"
        f"static const uint32_t CLICK[1025] = {{{click}}};\n"
    )


def _emulator(image: Path, log: Path, *more: str) -> list[str]:
    words = [QEMU, "-M", "mps2-an386", "-kernel", str(image), "-display", "none", "-monitor", "none"]
    words += ["-serial", "null", "-serial", f"file:{log}", "-icount", f"shift={SHIFT},sleep=off"]
    return [*words, *more]


def canned_log(image: Path, log: Path) -> str:
    """Run an image of the line `canned` to its end; return its log."""
    words = _emulator(image, log, "-semihosting-config", "enable=on,target=native")
    subprocess.run(words, check=True, timeout=120)
    return log.read_text()


class QemuLink(LockStepLink):
    """A link to an image of the line `mailbox`."""

    simulated = True

    def __init__(self, image: Path) -> None:
        super().__init__(f"qemu:{image}")
        self._folder = tempfile.TemporaryDirectory(prefix="pans-qemu-")
        shared = Path(self._folder.name) / "memory"
        with shared.open("w+b") as file:
            file.truncate(16 << 20)
            self._memory = mmap.mmap(file.fileno(), 16 << 20)
        backend = f"memory-backend-file,id=shared,mem-path={shared},size=16M,share=on"
        words = _emulator(image, Path(self._folder.name) / "log", "-object", backend)
        words[2] = "mps2-an386,memory-backend=shared"
        self._emulator = subprocess.Popen(words)
        self.run(0)

    def send(self, data: bytes) -> None:
        """Put bytes into the ring of what the device receives."""
        put, got = self._get(IN_PUT), self._get(IN_GOT)
        if len(data) > MAIL_RING - ((put - got) & 0xFFFFFFFF):
            raise LinkError("the emulator takes no more bytes")
        at = put % MAIL_RING
        first = data[: MAIL_RING - at]
        for start, part in ((at, first), (0, data[len(first) :])):
            self._memory[MAIL_AT + IN + start : MAIL_AT + IN + start + len(part)] = part
        self._set(IN_PUT, put + len(data))

    def run(self, until_ns: int) -> bytes:
        """Let time pass up to `until_ns`, or until the instrument has said something, which is returned."""
        ticks = until_ns * (TICK_HZ // 1_000_000) // 1000
        struct.pack_into("<Q", self._memory, MAIL_AT + UNTIL, ticks)
        asked = (self._get(GO) + 1) & 0xFFFFFFFF
        self._set(GO, asked)
        give_up = time.monotonic() + START_S
        while self._get(DONE) != asked:
            if self._emulator.poll() is not None or time.monotonic() > give_up:
                raise LinkError("the emulator has ended or hangs")
            os.sched_yield()
        self.at_ns = struct.unpack_from("<Q", self._memory, MAIL_AT + NOW)[0] * (10**9 // TICK_HZ)
        got, put = self._get(OUT_GOT), self._get(OUT_PUT)
        count, at = (put - got) & 0xFFFFFFFF, got % MAIL_RING
        base = MAIL_AT + OUT
        data = self._memory[base + at : base + min(at + count, MAIL_RING)]
        data += self._memory[base : base + count - len(data)]
        self._set(OUT_GOT, put)
        return data

    def end(self) -> None:
        """Switch the emulator off."""
        self._emulator.kill()
        self._emulator.wait()
        self._folder.cleanup()

    def _get(self, at: int) -> int:
        return int(struct.unpack_from("<I", self._memory, MAIL_AT + at)[0])

    def _set(self, at: int, value: int) -> None:
        struct.pack_into("<I", self._memory, MAIL_AT + at, value & 0xFFFFFFFF)


def open_qemu(url: str) -> Any:
    """Open `qemu:IMAGE.elf` (an entry point of `pans.devices`)."""
    open_links.append(QemuLink(Path(url.partition(":")[2])))
    return open_links[-1]
