"""An upload: what the device then holds, with and without the extension; devices and scenes that do not fit."""

from dataclasses import replace

import numpy as np
import pytest
from bundles import automaton_bundle, made_bundle, six_states
from lab_bench import SCENE, VirtualLab
from lab_firmware import Firmware
from lab_light import Light

from pans.base import SHIPPED
from pans.base.errors import DeviceError, UsageError
from pans.bundle.sensor import Bundle
from pans.bundle.sensor.bundle import load_bundle
from pans.decide.plan.plan import build_plan
from pans.instrument.profile import Profile, load_profile
from pans.live import device_check as fit
from pans.live.session import Session
from pans.protocol.wire import Opcode
from pans.protocol.wire.commands import Extension, announcement
from pans_sim.device.clock import DeviceClock
from pans_sim.device.instrument import Instrument
from pans_sim.ports.virtual import START_NS, VirtualLink
from pans_sim.scene.still import load_scene

DMD = load_profile("dmd-spad")
PROFILE = replace(DMD, projector=replace(DMD.projector, automaton_states=60_000, dwell_steps=4))
LIGHT = 50e-6 * PROFILE.projector.peak_photoelectrons_hz
BUNDLE = automaton_bundle(six_states(), photons=LIGHT)


def grey_bundle(profile: Profile) -> Bundle:
    levels = profile.projector.levels
    masks = np.random.default_rng(1).integers(0, levels, (3, 6))
    top = 50e-6 * profile.projector.peak_photoelectrons_hz
    return automaton_bundle(six_states(), photons=top / (levels - 1), levels=levels, pattern_levels=masks)


@pytest.mark.parametrize("levels", [2, 100])
def test_the_device_holds_what_the_bundle_has(levels: int) -> None:
    profile = replace(PROFILE, projector=replace(PROFILE.projector, levels=levels))
    bundle = BUNDLE if levels == 2 else grey_bundle(profile)
    plan, clock = build_plan(profile, bundle), DeviceClock(profile.clock.tick_hz)
    device = Instrument(profile, load_scene("uniform"), power_on_tick=clock.tick_at(START_NS))
    connection = Session(VirtualLink(device, clock, "upload"))
    facts = connection.handshake().facts
    fit.check_device(facts, plan, bundle, profile.clock.tick_hz)
    connection.upload(plan, bundle)
    assert np.array_equal(device._patterns.stack(3), bundle.pattern_levels)
    held = device._states.states
    assert np.array_equal(held.successors, six_states().successors)
    assert np.array_equal(held.light, six_states().dwell / 4)
    opcodes = {opcode for opcode, _ in fit.upload_commands(plan, bundle, facts)}
    assert (Opcode.LOAD_MASKS in opcodes) is (levels == 2)


def test_an_older_device_gets_fixed_patterns_as_before() -> None:
    fixed = made_bundle(photons_per_level=LIGHT, table=np.zeros((4, 2)))
    plan = build_plan(PROFILE, fixed)
    opcodes = [opcode for opcode, _ in fit.upload_commands(plan, fixed, {})]
    assert opcodes == [Opcode.LOAD_PATTERN, Opcode.LOAD_PATTERN, Opcode.LOAD_PLAN]


def test_a_device_that_knows_no_automata_is_refused_before_anything_is_sent() -> None:
    """The firmware in tests/independent was written before there were automata."""
    connection = Session(VirtualLab(Firmware(Light.of_scene(SCENE, 1e5, 2, 0))))
    facts = connection.handshake().facts
    plan = build_plan(PROFILE, BUNDLE)
    with pytest.raises(DeviceError, match="announces no automata, needed 0xd00a27ff") as refused:
        fit.check_automaton(facts, plan)
    assert "fixed patterns" in refused.value.remedy
    connection.host.submit(Opcode.LOAD_STATES, b"", may_be_refused=True)  # and if one were sent all the same
    connection.wait_acknowledged()
    assert connection.host.refusals[0].status == 1


@pytest.mark.parametrize(
    ("facts", "drive", "words"),
    [
        ({"automaton_schema": 1}, "device", "automata of schema 0x00000001"),
        (announcement(Extension(5, 4)), "device", "up to 5 states, needed 6"),
        (announcement(Extension(0, 6)), "host", "into 6 dwell steps, needed a multiple of 4"),
    ],
)
def test_a_device_that_cannot_run_the_automaton_is_refused_with_the_numbers(facts, drive, words) -> None:
    with pytest.raises(DeviceError, match=words):
        fit.check_automaton(facts, build_plan(PROFILE, BUNDLE, drive=drive))


def test_a_device_without_states_can_be_driven_by_the_host() -> None:
    fit.check_automaton(announcement(Extension(0, 4)), build_plan(PROFILE, BUNDLE, drive="host"))


FASHION = load_bundle(SHIPPED / "fashion10.pans")[0]


def test_what_belongs_together_is_taken() -> None:
    for facts in (
        {},
        fit.scene_facts(None, ()),
        fit.scene_facts((28, 28), ()),
        fit.scene_facts(None, FASHION.classes),
        fit.scene_facts((28, 28), FASHION.classes),
        fit.scene_facts((28, 28), [str(number) for number in range(10)]),  # as many without names
    ):
        fit.check_scene(facts, FASHION)


@pytest.mark.parametrize(
    ("shape", "classes", "words"),
    [
        ((14, 14), FASHION.classes, "14 x 14 pixels"),
        ((28, 28), ("cat", "dog"), "cat, dog"),
        ((28, 28), ("0", "1"), "0, 1"),
        ((28, 28), FASHION.classes[::-1], "Ankle boot, Bag, Sneaker"),
        ((784, 1), (), "784 x 1 pixels and the classes unknown"),
    ],
)
def test_what_does_not_is_refused(shape: tuple[int, int], classes: tuple[str, ...], words: str) -> None:
    with pytest.raises(UsageError) as caught:
        fit.check_scene({"scene": "s", **fit.scene_facts(shape, classes)}, FASHION)
    assert words in caught.value.message
    assert "the bundle has 28 x 28 pixels and the classes T-shirt/top, Trouser" in caught.value.message


def test_names_of_any_length_fit_into_a_welcome() -> None:
    for classes in (["é" * 300] * 3, [str(i) for i in range(10_000)], ["a\nb", "\ud800"]):
        assert all(len(str(fact).encode()) <= 256 for fact in fit.scene_facts((1, 2), classes).values())
    assert fit.TEXT_MAX_BYTES < 256
