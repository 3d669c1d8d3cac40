"""The firmware by itself: strange input under sanitizers, and its size on two small processors."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from c_core import COMPILER
from c_device import NONCE, Pair, needs_compiler

from pans.protocol.wire import MessageType, Opcode
from pans.protocol.wire import messages as wire
from pans_sim.pc_instrument.core import FOLDER, core_sources

STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror")
SANITIZERS = ("-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
# name -> compiler and its words; what the document states for each, in bytes
TARGETS = {
    "Cortex-M0+": ("arm-none-eabi-gcc", ("-mcpu=cortex-m0plus", "-mthumb"), 17_000),
    "Cortex-M4": ("arm-none-eabi-gcc", ("-mcpu=cortex-m4", "-mthumb"), 15_500),
    "Cortex-M33": ("arm-none-eabi-gcc", ("-mcpu=cortex-m33", "-mthumb"), 15_500),
    "RV32": ("riscv64-unknown-elf-gcc", ("-march=rv32imac", "-mabi=ilp32", "--specs=picolibc.specs"), 18_000),
}
MOST_STACK_OF_A_FUNCTION = 176
ALLOCATORS = re.compile(r"\b(malloc|calloc|realloc|free|alloca)\b")


def run(*words: str | Path, folder: Path, seconds: float = 120) -> str:
    done = subprocess.run([*map(str, words)], cwd=folder, capture_output=True, text=True, timeout=seconds)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def compiled_for(target: str, folder: Path) -> list[Path]:
    """The core's objects for one of TARGETS, warnings being errors; skipped without its compiler."""
    compiler, words, _ = TARGETS[target]
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed")
    run(compiler, *STRICT, "-Os", *words, "-fstack-usage", "-c", *core_sources(), folder=folder)
    return [folder / f"{path.stem}.o" for path in core_sources()]


@needs_compiler
def test_strange_input_harms_nothing(tmp_path: Path) -> None:
    program = tmp_path / "fuzz"
    words = [*COMPILER, "-std=c99", *SANITIZERS, *core_sources(), FOLDER / "fuzz" / "fuzz.c", "-o", program]
    built = subprocess.run([*map(str, words)], capture_output=True, text=True)
    if built.returncode and "asan" in built.stderr:
        pytest.skip("this compiler has no sanitizers")
    assert built.returncode == 0, built.stderr
    said = run(program, "2", "3", folder=tmp_path)
    figures = {name: int(number) for number, name in re.findall(r"(\d+) ([a-z]+)", said)}
    assert figures["frames"] > 1000
    assert figures["armed"] > 3
    assert figures["blocks"] > 30


@needs_compiler
def test_what_exposed_had_to_tell_when_there_was_no_room_it_tells_later() -> None:
    """More answers at once than the core holds, and a STOP behind them, whose EXPOSED and STATUS find no room."""
    pair = Pair("sequential")
    hz = pair.profile.clock.tick_hz
    pair.open()
    pair.arm(cycles=10_000)
    pair.after(hz // 10)
    before = len(pair.heard[1])
    again = wire.encode_command(pair.last_id, Opcode.STOP, b"", NONCE)  # of an id that has been carried out: an ACK
    pair.after(5, again * 400 + wire.encode_command(pair.last_id + 1, Opcode.STOP, b"", NONCE))
    assert not any(frame.type == MessageType.STATUS for frame in pair.heard[1][before:])
    pair.after(2 * hz)
    statuses = [wire.decode_status(f.payload) for f in pair.heard[1] if f.type == MessageType.STATUS]
    told = [wire.decode_exposed(f.payload).exposures for f in pair.heard[1] if f.type == MessageType.EXPOSED]
    assert sum(told) == statuses[-1].next_exposure > 500


@pytest.mark.parametrize("target", TARGETS)
def test_the_core_fits_a_small_processor(target: str, tmp_path: Path) -> None:
    objects = compiled_for(target, tmp_path)
    compiler, _, most = TARGETS[target]
    sizes = run(compiler.replace("gcc", "size"), "-t", *objects, folder=tmp_path).splitlines()[-1].split()
    text, data, bss = map(int, sizes[:3])
    assert text <= most
    assert (data, bss) == (0, 0), "the core has memory of its own: all of it is the caller's"
    for path in objects:
        for line in path.with_suffix(".su").read_text().splitlines():
            _, used, kind = line.split("\t")
            assert kind == "static", line
            assert int(used) <= MOST_STACK_OF_A_FUNCTION, line


def test_the_core_allocates_nothing_and_calls_no_system() -> None:
    for path in (*core_sources(), *FOLDER.glob("*.h")):
        text = re.sub(r"/\*.*?\*/", "", path.read_text(), flags=re.DOTALL)
        assert not ALLOCATORS.search(text), path
        headers = set(re.findall(r"#include <([^>]+)>", text))
        assert headers <= {"string.h", "stdbool.h", "stddef.h", "stdint.h"}, path
