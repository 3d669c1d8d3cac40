"""The firmware of the Pico, built with the vendor's SDK, in an emulator of the chip: edges of its pins in ns, against the plan and against
what the device tells of itself. tests/instruments/rp2040_link.py says what this needs.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import json_of
from lock_step import open_links, register
from rp2040_link import BENCH, Rp2040Link, build, missing, open_rp2040, symbols

from pans.base.errors import LinkError
from pans.instrument.profile import load_profile, profile_text
from pans.protocol.wire.commands import Arm, Gate, PlanChunk, pack_command, unpack_command
from pans.protocol.wire.framing import Frame, FrameDecoder
from pans.protocol.wire.messages import decode_command
from pans.protocol.wire.schema import DeviceState, MessageType, Opcode
from pans_sim.conform.bench import Bench

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(missing()), reason=f"not here: {missing()}")]

TICK_NS = 1000
DARK_NS = 101_000_000  # the watchdog, and one turn of the main loop before the hang
PIO_NS = 32  # as exactly as the emulator knows when an instruction reaches PIO
RAM = 0x20000000
FLASH_BYTES, SECTOR_BYTES = 2 << 20, 4096
AS_EMULATED = {
    'name = "dmd-spad"': 'name = "pico"',
    "pattern_memory = 43_690": "pattern_memory = 4_096",
    "automaton_states = 43_690": "automaton_states = 4_096",
    "afterpulse_probability = 0.005": "afterpulse_probability = 0.0",
    "readout_us = 3.0": "readout_us = 10.0",
    "tick_hz = 100_000_000": "tick_hz = 1_000_000",
    "device_turn_us = 44.0": "device_turn_us = 50.0",
}


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Builds the firmware with more words for cmake, once for each; returns pans.bin. No warning may come."""
    made: dict[tuple[str, ...], Path] = {}

    def image(*words: str) -> Path:
        if words not in made:
            folder = tmp_path_factory.mktemp("build")
            said = build(folder, *words)
            assert "warning" not in said
            made[words] = folder / "pans.bin"
        return made[words]

    return image


@pytest.fixture(scope="module")
def profile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped profile as this board and its bench have it."""
    text = profile_text("dmd-spad")
    for shipped, here in AS_EMULATED.items():
        assert shipped in text
        text = text.replace(shipped, here)
    path = tmp_path_factory.mktemp("profile") / "pico.toml"
    path.write_text(text)
    return path


@pytest.fixture
def opened() -> Iterator[Callable[[Path], Rp2040Link]]:
    """Opens links, and ends those that are open."""
    yield lambda image: open_rp2040(f"rp2040:{image}")
    while open_links:
        open_links.pop().end()


@pytest.mark.parametrize(("board", "ram_kib"), [("pico", 256), ("pico2", 512)])
def test_it_builds_and_fits(built: Callable[..., Path], board: str, ram_kib: int) -> None:
    image = built() if board == "pico" else built(f"-DPICO_BOARD={board}")
    at = symbols(image.with_suffix(".elf"))
    flash, used = image.stat().st_size, at["__bss_end__"] - RAM
    print(board, {"flash_bytes": flash, "ram_bytes": used, "stack_bytes": at["__StackTop"] - at["__StackBottom"]})
    assert flash < 64 << 10
    assert used + (24 << 10) < ram_kib << 10


def pulses(log: dict[str, Any], name: str) -> tuple[np.ndarray, np.ndarray]:
    """When a pin has risen and fallen, in ns."""
    rose, fell = ([at for pin, on, at in log["edges"] if pin == name and on == level] for level in (1, 0))
    assert 0 <= len(rose) - len(fell) <= 1
    return np.array(rose[: len(fell)]), np.array(fell)


def frames(data: bytes) -> list[Frame]:
    return FrameDecoder().feed(bytes(data))


def planned(link: Rp2040Link, exposures: int) -> tuple[np.ndarray, int]:
    """When each exposure of the last run shall begin and how long it shall be, in ns: what the host has sent."""
    orders = [decode_command(one.payload) for one in frames(link.sent) if one.type == MessageType.COMMAND]
    bodies = {one.opcode: one.body for one in orders}
    plan, start = (
        unpack_command(PlanChunk, bodies[Opcode.LOAD_PLAN]),
        unpack_command(Arm, bodies[Opcode.ARM]).start_tick,
    )
    cycle, slot = np.divmod(np.arange(exposures), plan.n_slots)
    begins = start + cycle * plan.cycle_ticks + plan.slots["offset_ticks"][slot].astype(np.int64)
    return begins * TICK_NS, plan.exposure_ticks * TICK_NS


def told(link: Rp2040Link) -> list[tuple[int, int, int, int, int]]:
    """The device's EXPOSED: exposures, worst start error and length error in ticks, their numbers."""
    return [struct.unpack("<IiiQQ", one.payload) for one in frames(link.heard) if one.type == MessageType.EXPOSED]


def check_pins(link: Rp2040Link, exposures: int) -> tuple[np.ndarray, np.ndarray]:
    """The device tells of every exposure, and of what the pins did; return the start and length errors of the gate in ns."""
    rose, fell = pulses(link.log(), "gate")
    assert len(rose) == len(fell) == exposures
    begins, length = planned(link, exposures)
    late, longer = rose - begins, fell - rose - length
    assert sum(one[0] for one in told(link)) == exposures
    for _, start, more, start_at, more_at in told(link):
        assert abs(start * TICK_NS - late[start_at]) <= TICK_NS
        assert abs(more * TICK_NS - longer[more_at]) <= TICK_NS
    print({"start_ns": [np.median(late), late.max()], "length_ns": [np.median(longer), longer.min(), longer.max()]})
    return late, longer


@contextmanager
def on_the_path(folder: Path) -> Iterator[None]:
    """Makes `rp2040:IMAGE` a device URL."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(register(folder / "site", "rp2040", "rp2040_link:open_rp2040"))
        yield


def run(
    capsys: pytest.CaptureFixture[str], folder: Path, image: Path, profile: Path, decisions: int, code: int
) -> dict[str, Any]:
    with on_the_path(folder):
        words = ("--device", f"rp2040:{image}", "--profile", profile, "--decisions", decisions, "--drive", "device")
        return json_of(capsys, "run fashion-adaptive", *words, "--out", folder / "run", code=code)


@pytest.mark.usefixtures("opened")
def test_the_shipped_automaton_on_the_tick(
    built: Callable[..., Path], profile: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = run(capsys, tmp_path, built(), profile, 40, 0)
    assert found["verdict"] == "PASS"
    (link,) = open_links
    exposures = found["stream"]["exposures"]
    assert found["exposure_timing"]["exposures"] == exposures >= 1000
    late, longer = check_pins(link, exposures)
    assert late.min() >= 0
    assert late.max() <= TICK_NS
    assert np.abs(longer).max() <= TICK_NS
    log = link.log()
    (rose, fell), (lit, out), (click, _) = (pulses(log, name) for name in ("gate", "light", "pulse"))
    before = np.searchsorted(rose, lit, side="right") - 1
    assert (lit == rose[before]).all()
    assert (out <= fell[before]).all()
    counted = round(found["clicks_mean"] * found["decisions"]) + found["dark"]["clicks"]
    least, most = (
        np.count_nonzero(np.searchsorted(click, fell + by) > np.searchsorted(click, rose - by))
        for by in (-PIO_NS, PIO_NS)
    )
    assert least <= counted <= most
    assert least > 0.9 * most > 100


def test_it_keeps_every_rule(
    built: Callable[..., Path], profile: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], opened: Any
) -> None:
    with on_the_path(tmp_path):
        found = json_of(capsys, "conform", f"rp2040:{built()}", "--profile", profile)
    assert (found["verdict"], found["broken"], found["gone"]) == ("PASS", [], None)
    assert found["kept"] >= 69


def bench_of(link: Rp2040Link, profile: Path) -> Bench:
    bench = Bench(link, load_profile(str(profile)), 64)
    bench.open()
    return bench


def test_the_shortest_plan_that_it_takes(
    built: Callable[..., Path], profile: Path, opened: Callable[[Path], Rp2040Link]
) -> None:
    link = opened(built())
    bench = bench_of(link, profile)
    plan = bench.layout(shown=(0, 1) * 8, exposure_ticks=40, period_ticks=50, seamless=True)
    bench.run(plan, 100)
    late, longer = check_pins(link, 1600)
    assert late.min() >= 0
    assert late.max() <= TICK_NS
    assert np.abs(longer).max() <= TICK_NS


@pytest.mark.parametrize("loop", ["pans_turn", "pans_edge"])
def test_a_loop_that_hangs_is_dark(
    built: Callable[..., Path], profile: Path, opened: Callable[[Path], Rp2040Link], loop: str
) -> None:
    image = built()
    link = opened(image)
    bench = bench_of(link, profile)
    epoch = bench.facts["epoch"]
    bench.start(bench.layout(exposure_ticks=400, period_ticks=500))
    bench.done(Opcode.GATE, pack_command(Gate(int(bench.ping().tx_tick) + 20_000, 10_000_000, 0)))
    bench.listen(0.1)
    begun = sum(pin == "gate" and on for pin, on, _ in link.log()["edges"])
    link.hang(50, symbols(image.with_suffix(".elf"))[loop])
    with pytest.raises(LinkError):
        bench.listen(1.0)
    log = link.log()
    (rose, fell), (_, out) = pulses(log, "gate"), pulses(log, "light")
    hung = rose[begun + 49]
    (bitten,) = [at for pin, _, at in log["edges"] if pin == "watchdog"]
    assert pulses(log, "output 0")[1] == [bitten]
    assert max(fell[-1], out[-1], bitten) <= hung + DARK_NS
    if loop == "pans_edge":  # in the interrupt: gate and light end by themselves, and no exposure follows
        assert rose[-1] == hung
        assert fell[-1] - rose[-1] == 400 * TICK_NS
        assert out[-1] <= fell[-1]
    print({"dark_after_ms": (max(fell[-1], out[-1]) - hung) / 1e6, "watchdog_after_ms": (bitten - hung) / 1e6})
    link.reopen()
    bench.open(reset=False)
    assert bench.facts["epoch"] == epoch + 1
    assert bench.until_state(DeviceState.IDLE)
    bench.listen(0.2)
    assert len(pulses(link.log(), "gate")[0]) == len(rose)


def with_records(image: Path, path: Path, epochs: list[int], last: bytes = b"") -> Path:
    """Write a flash whose last two sectors hold these epochs and then `last`; what is not erased elsewhere stays so."""
    kept = b"".join(struct.pack("<II", one, one ^ 0xFFFFFFFF) for one in epochs) + last
    flash = bytearray(image.read_bytes().ljust(FLASH_BYTES - 2 * SECTOR_BYTES, b"\xff"))
    path.write_bytes(flash + kept.ljust(SECTOR_BYTES, b"\xff") + b"\x5a" * SECTOR_BYTES)
    return path


@pytest.mark.parametrize(
    ("epochs", "last", "expected"),
    [([], b"\x00" * 8, 1), ([7, 8], b"\xf9\xff\xff\xff\xff\xff\xff\xff", 9), (list(range(40, 552)), b"", 552)],
    ids=["of another firmware", "power went while it was written", "a sector is full"],
)
def test_every_start_has_another_epoch(
    built: Callable[..., Path],
    profile: Path,
    opened: Callable[[Path], Rp2040Link],
    tmp_path: Path,
    epochs: list[int],
    last: bytes,
    expected: int,
) -> None:
    link = opened(with_records(built(), tmp_path / "pans.bin", epochs, last))
    bench = bench_of(link, profile)
    for epoch in (expected, expected + 1):
        assert bench.facts["epoch"] == epoch
        link.hang(1, symbols(built().with_suffix(".elf"))["pans_turn"])
        with pytest.raises(LinkError):
            bench.start(bench.layout())
            bench.listen(1.0)
        link.reopen()
        bench.open()
    assert bench.facts["epoch"] == expected + 2


@pytest.mark.usefixtures("opened")
def test_the_polled_board_is_judged(
    built: Callable[..., Path], profile: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = built(f"-DPANS_BOARD={BENCH.parent / 'polled.c'}")
    found = run(capsys, tmp_path, image, profile, 20, 4)
    assert found["verdict"] == "FAIL"
    (link,) = open_links
    late, longer = check_pins(link, found["stream"]["exposures"])
    assert max(late.max(), np.abs(longer).max()) > 5 * TICK_NS
    told_us = (found["exposure_timing"][name] for name in ("worst_start_us", "worst_length_us"))
    for worst_us, errors in zip(told_us, (late, longer), strict=True):
        assert abs(worst_us * 1000 - errors[np.argmax(np.abs(errors))]) <= TICK_NS
