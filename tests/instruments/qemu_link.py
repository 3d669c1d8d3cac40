"""The reference firmware as an Arm image in QEMU: how it is built, a link to it in virtual time, and the log of a run without a host.

The board is firmware_sim/pans_sim/reference/mps2. With lockstep.c its time stands still while the host works, so that nothing
depends on how busy the machine is. `open_qemu` opens `qemu:IMAGE.elf`.
"""

from __future__ import annotations

import math
import os
import select
import shutil
import struct
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from lock_step import LockStepLink, open_links

from pans.base.errors import LinkError
from pans_sim import device

FOLDER = Path(device.__file__).parents[1] / "reference"
COMPILER, QEMU = "arm-none-eabi-gcc", "qemu-system-arm"
CPUS = {"m0plus": "-mcpu=cortex-m0plus", "m4": "-mcpu=cortex-m4"}
STRICT = ("-std=gnu11", "-O2", "-mthumb", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror")
LINKING = ("-nostartfiles", "-ffunction-sections", "-specs=nano.specs", "-specs=nosys.specs", "-Wl,--gc-sections")
SHIFT = 4  # QEMU counts 2^SHIFT ns an instruction: a processor of 62.5 million a second
TICK_HZ = 25_000_000
PIPE_BYTES = 4096  # written at once
HANGS_S = 60.0


def missing() -> str:
    """Return which program is not installed, "" if none."""
    return next((name for name in (COMPILER, QEMU) if shutil.which(name) is None), "")


def instructions(ticks: int) -> int:
    """How many instructions the emulated processor carries out in so many ticks, rounded up."""
    return math.ceil(ticks * 10**9 / TICK_HZ / 2**SHIFT)


def build(folder: Path, cpu: str, line: str, *defines: str) -> Path:
    """Compile the board with the core for `cpu` and the line `canned` or `lockstep`; warnings are errors."""
    image = folder / f"{'-'.join((line, cpu, *defines))}.elf"
    board = [FOLDER / "mps2" / name for name in ("start.c", "board.c", f"{line}.c")]
    if line == "lockstep":
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


def _emulator(image: Path, log: Path) -> list[str]:
    words = [QEMU, "-M", "mps2-an386", "-kernel", str(image), "-display", "none", "-monitor", "none"]
    words += ["-semihosting-config", "enable=on,target=native"]
    return [*words, "-serial", "null", "-serial", f"file:{log}", "-icount", f"shift={SHIFT},sleep=off"]


def canned_log(image: Path, log: Path) -> str:
    """Run an image of the line `canned` to its end; return its log."""
    subprocess.run(_emulator(image, log), check=True, timeout=120)
    return log.read_text()


class QemuLink(LockStepLink):
    """A link to an image of the line `lockstep`."""

    simulated = True

    def __init__(self, image: Path) -> None:
        super().__init__(f"qemu:{image}")
        self._folder = tempfile.TemporaryDirectory(prefix="pans-qemu-")
        folder, self._sending = Path(self._folder.name), b""
        pipes = [folder / name for name in ("in", "out")]
        for path in pipes:
            os.mkfifo(path)
        self._in, self._out = (os.open(path, os.O_RDWR) for path in pipes)  # both ways: neither waits for the other end
        self._emulator = subprocess.Popen(_emulator(image.resolve(), folder / "log"), cwd=folder)
        self.run(0)

    def send(self, data: bytes) -> None:
        """Bytes that the device receives when time goes on."""
        self._sending += data

    def run(self, until_ns: int) -> bytes:
        """See `LockStepLink`."""
        words, self._sending = self._sending, b""
        os.write(self._in, struct.pack("<QI", until_ns * (TICK_HZ // 1_000_000) // 1000, len(words)))
        for start in range(0, len(words), PIPE_BYTES):
            os.write(self._in, words[start : start + PIPE_BYTES])
        ticks, count = struct.unpack("<QI", self._take(12))
        self.at_ns = ticks * (10**9 // TICK_HZ)
        return self._take(count)

    def end(self) -> None:
        """Switch the emulator off."""
        self._emulator.kill()
        self._emulator.wait()
        for pipe in (self._in, self._out):
            os.close(pipe)
        self._folder.cleanup()

    def _take(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            if not select.select([self._out], [], [], HANGS_S)[0]:
                raise LinkError("the emulator has ended or hangs")
            data += os.read(self._out, count - len(data))
        return data


def open_qemu(url: str) -> Any:
    """Open `qemu:IMAGE.elf` (an entry point of `pans.devices`)."""
    open_links.append(QemuLink(Path(url.partition(":")[2])))
    return open_links[-1]
