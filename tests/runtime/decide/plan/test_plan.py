"""Plans: every exposure where it belongs, and a refusal with numbers for what the hardware cannot do."""

import re
from dataclasses import replace

import numpy as np
import pytest
from bundles import made_bundle
from hypothesis import given
from hypothesis import strategies as st

from pans.base.errors import PlanError, UsageError
from pans.bundle.sensor import Bundle
from pans.decide.plan.plan import MAX_BLOCK_EXPOSURES, NO_SHOT, Plan, build_plan, exposure_us
from pans.instrument.profile import Profile, load_profile
from pans.protocol.wire import DARK_PATTERN, MAX_PAYLOAD_BYTES

OLED, DMD, WDM, IDEAL = (load_profile(name) for name in ("oled-qcmos", "dmd-spad", "wdm-snspd", "ideal"))


def bundle_for(profile: Profile, n_patterns: int, exposure: float, shape: tuple[int, int] = (2, 3)) -> Bundle:
    """A bundle of `n_patterns` full-bright patterns that needs `exposure` microseconds on `profile`."""
    levels = profile.projector.levels
    top = exposure * 1e-6 * profile.projector.peak_photoelectrons_hz
    made = made_bundle(
        image_shape=shape,
        levels=levels,
        pattern_levels=np.full((1, shape[0] * shape[1]), levels - 1, np.uint16),
        photons_per_level=top / (levels - 1),
        table=np.zeros((2, 2), np.float32),
    )
    return replace(made, pattern_levels=np.repeat(made.pattern_levels, n_patterns, axis=0))


def blocks_of(plan: Plan) -> list[range]:
    """Cut one cycle into blocks as the protocol says: full, or the next exposure is not equally spaced, or the cycle ends."""
    blocks, start = [], 0
    for slot in range(1, plan.slots_per_cycle + 1):
        full = slot - start == plan.block_exposures
        last = slot == plan.slots_per_cycle
        jump = not last and plan.slot_offset_ticks[slot] - plan.slot_offset_ticks[slot - 1] != plan.slot_period_ticks
        if full or last or jump:
            blocks.append(range(start, slot))
            start = slot
    return blocks


def check_sound(plan: Plan, profile: Profile, n_patterns: int, shots: int, dark_displays: int) -> None:
    """What holds for every plan."""
    spacing = plan.exposure_ticks + profile.exposure.readout_us * profile.clock.tick_hz / 1e6 - 1e-6
    offsets = plan.slot_offset_ticks
    assert offsets[0] == 0
    assert np.all(np.diff(offsets) >= spacing)
    assert plan.cycle_ticks - offsets[-1] >= spacing  # the next cycle's first exposure keeps its distance too
    dark = plan.slot_pattern == DARK_PATTERN
    assert np.array_equal(dark, plan.slot_shot == NO_SHOT)
    lit = list(zip(plan.slot_pattern[~dark].tolist(), plan.slot_shot[~dark].tolist(), strict=True))
    patterns = 1 if plan.mode == "parallel" else n_patterns
    assert sorted(lit) == [(p, s) for p in range(patterns) for s in range(plan.shots_per_cycle)]
    assert plan.shots_per_object == shots
    exposures_per_display = plan.shots_per_cycle if plan.mode == "sequential" else 1
    assert plan.dark_slots_per_cycle == dark_displays * exposures_per_display
    assert not dark[-1]
    assert all(len(block) <= MAX_BLOCK_EXPOSURES for block in blocks_of(plan))
    for array in (offsets, plan.slot_pattern, plan.slot_shot):
        assert not array.flags.writeable


def check_pattern_rate(plan: Plan, profile: Profile) -> None:
    """No display is shorter than a refresh period."""
    displays = np.flatnonzero(np.diff(plan.slot_pattern.astype(int), prepend=-1))
    starts = np.append(plan.slot_offset_ticks[displays], plan.cycle_ticks)
    assert np.diff(starts).min() >= profile.clock.tick_hz / profile.projector.pattern_rate_max_hz * (1 - 1e-9)


@given(
    st.sampled_from([OLED, DMD, IDEAL]),
    st.integers(1, 70),
    st.integers(1, 40),
    st.integers(0, 7),
    st.sampled_from(["auto", "shot-major", "pattern-major"]),
    st.floats(0, 1),
)
def test_sequential_plans_are_sound(profile, n_patterns, shots, dark, order, where):
    low, high = profile.exposure.min_us, min(profile.exposure.max_us, 20_000.0)
    bundle = bundle_for(profile, n_patterns, low + where * (high - low))
    plan = build_plan(profile, bundle, shots_per_object=shots, dark_slots_per_cycle=dark, order=order)
    check_sound(plan, profile, n_patterns, shots, dark)
    check_pattern_rate(plan, profile)
    assert plan.exposure_us == pytest.approx(exposure_us(profile, bundle), abs=0.51 * plan.tick_us)
    quarter = profile.timing.decision_deadline_us / 4
    for block in blocks_of(plan):
        period_us = plan.slot_period_ticks * plan.tick_us
        if plan.shots_per_cycle == 1:
            assert len(block) == 1 or len(block) * period_us <= quarter * (1 + 1e-9)
        else:
            assert len({plan.slot_pattern[slot] for slot in block}) == 1


@given(st.integers(1, 32), st.integers(1, 300), st.integers(0, 7), st.floats(1, 1000))
def test_parallel_plans_are_sound(n_patterns, shots, dark, exposure):
    plan = build_plan(WDM, bundle_for(WDM, n_patterns, exposure), shots_per_object=shots, dark_slots_per_cycle=dark)
    check_sound(plan, WDM, n_patterns, shots, dark)
    assert plan.n_patterns == n_patterns
    assert plan.shots_per_cycle == shots
    assert set(plan.slot_pattern.tolist()) <= {0, DARK_PATTERN}
    assert len(set(np.diff(plan.slot_offset_ticks).tolist())) <= 1  # frames are equally spaced


@given(
    st.sampled_from([OLED, DMD, IDEAL]),
    st.integers(1, 20),
    st.integers(1, 40),
    st.integers(0, 3),
    st.floats(40, 10_000),
)
def test_auto_takes_the_shorter_time_per_object(profile, n_patterns, shots, dark, exposure):
    bundle = bundle_for(profile, n_patterns, float(np.clip(exposure, profile.exposure.min_us, profile.exposure.max_us)))
    auto, shot, pattern = (
        build_plan(profile, bundle, shots_per_object=shots, dark_slots_per_cycle=dark, order=order)
        for order in ("auto", "shot-major", "pattern-major")
    )
    assert auto.object_ticks == min(shot.object_ticks, pattern.object_ticks)
    if shot.object_ticks == pattern.object_ticks:
        assert auto.shots_per_cycle == 1


def test_five_exposures_of_the_paper_fit_into_one_refresh_period():
    plan = build_plan(OLED, bundle_for(OLED, 10, 3000.0), shots_per_object=5)
    assert plan.shots_per_cycle == 5
    assert plan.block_exposures == 5
    assert plan.slot_period_ticks == 33_000
    assert plan.cycle_ticks == 11 * 166_667  # ten patterns and the dark one, 1/60 s each, at 10 MHz, rounded up
    assert plan.objects_hz == pytest.approx(60 / 11, rel=1e-5)
    six = build_plan(OLED, bundle_for(OLED, 10, 3000.0), shots_per_object=6, order="pattern-major")
    assert six.cycle_ticks == 11 * 333_334  # the sixth exposure needs another refresh period


def test_shot_major_shows_each_pattern_once_per_cycle():
    plan = build_plan(DMD, bundle_for(DMD, 4, 50.0), shots_per_object=3, order="shot-major")
    assert plan.slot_pattern.tolist() == [DARK_PATTERN, 0, 1, 2, 3]
    assert plan.slot_shot.tolist() == [NO_SHOT, 0, 0, 0, 0]
    assert plan.slot_offset_ticks.tolist() == [0, 5300, 10600, 15900, 21200]  # 50 us and 3 us of readout at 100 MHz
    assert (plan.cycle_ticks, plan.cycles_per_object, plan.exposure_ticks) == (26500, 3, 5000)
    assert plan.cycle_us == pytest.approx(265.0)
    assert plan.objects_hz == pytest.approx(1e6 / 795)
    assert plan.block_exposures == 3  # a quarter of 1000 us holds four exposures: two blocks, of three and two


def test_dark_displays_are_spread_evenly():
    plan = build_plan(DMD, bundle_for(DMD, 6, 50.0), dark_slots_per_cycle=3, order="shot-major")
    assert np.flatnonzero(plan.slot_pattern == DARK_PATTERN).tolist() == [0, 3, 6]
    none = build_plan(DMD, bundle_for(DMD, 6, 50.0), dark_slots_per_cycle=0)
    assert none.dark_slots_per_cycle == 0
    held = build_plan(OLED, bundle_for(OLED, 4, 3000.0), shots_per_object=2, dark_slots_per_cycle=2)
    dark = DARK_PATTERN
    assert held.slot_pattern.tolist() == [dark, dark, 0, 0, 1, 1, dark, dark, 2, 2, 3, 3]


def test_blocks_do_not_outgrow_a_message():
    plan = build_plan(IDEAL, bundle_for(IDEAL, 2, 10.0), shots_per_object=5000, order="pattern-major")
    assert max(len(block) for block in blocks_of(plan)) == 1000
    assert len(blocks_of(plan)) == 15


def test_a_block_of_wide_frames_fits_into_a_message():
    wide = replace(
        WDM, detector=replace(WDM.detector, channels=4096), projector=replace(WDM.projector, pattern_memory=4096)
    )
    wide = replace(wide, timing=replace(wide.timing, decision_deadline_us=1e6))
    plan = build_plan(wide, bundle_for(wide, 4096, 1.0), shots_per_object=5000)
    assert 20 <= plan.block_exposures <= MAX_PAYLOAD_BYTES // 512
    narrow = build_plan(wide, bundle_for(wide, 8, 1.0), shots_per_object=5000)
    assert narrow.block_exposures == 1001  # 5001 frames in five blocks


def refusal(profile: Profile, bundle: Bundle, **asked: object) -> PlanError:
    with pytest.raises(PlanError) as caught:
        build_plan(profile, bundle, **asked)  # type: ignore[arg-type]
    return caught.value


def many(profile: Profile, n: int, **changes: int) -> tuple[Profile, Bundle]:
    return replace(profile, detector=replace(profile.detector, **changes)), bundle_for(profile, n, 10.0)


@pytest.mark.parametrize(
    ("profile", "bundle", "asked", "words"),
    [
        (DMD, bundle_for(OLED, 2, 1000.0), {}, ["124 levels", "has 2"]),
        (DMD, bundle_for(DMD, 1, 50.0, (769, 10)), {}, ["10 x 769 pixels", "1024 x 768"]),
        (DMD, bundle_for(DMD, 1, 50.0, (10, 1025)), {}, ["1025 x 10 pixels", "1024 x 768"]),
        (OLED, bundle_for(OLED, 1025, 1000.0), {}, ["1025 patterns", "holds 1024"]),
        (*many(WDM, 9, channels=8), {}, ["9 patterns", "8 detector channels"]),
        (OLED, bundle_for(OLED, 2, 599.9), {}, ["takes 599.9 us, allowed are 600 to 3000 us", "too bright"]),
        (OLED, bundle_for(OLED, 2, 3000.1), {}, ["takes 3000.1 us, allowed are 600 to 3000 us", "too weak"]),
        (IDEAL, bundle_for(IDEAL, 20, 10.0), {"shots_per_object": 0}, ["from 1 to 65534, found 0"]),
        (IDEAL, bundle_for(IDEAL, 20, 10.0), {"shots_per_object": 65535}, ["from 1 to 65534, found 65535"]),
        (IDEAL, bundle_for(IDEAL, 20, 10.0), {"dark_slots_per_cycle": -1}, ["from 0 to 65534, found -1"]),
        (IDEAL, bundle_for(IDEAL, 20, 10.0), {"shots_per_object": 60_000, "order": "pattern-major"}, ["1260000 slots"]),
        (
            replace(DMD, projector=replace(DMD.projector, pattern_rate_max_hz=0.01)),
            bundle_for(DMD, 2, 50.0),
            {},
            ["42.95 s"],
        ),
        (WDM, bundle_for(WDM, 2, 10.0), {"order": "shot-major"}, ["auto in parallel mode"]),
        (IDEAL, replace(bundle_for(IDEAL, 1, 10.0), photons_per_level=0.0), {}, ["above 0, found 0.0"]),
    ],
)
def test_what_the_hardware_cannot_do_is_refused_with_the_numbers(profile, bundle, asked, words):
    error = refusal(profile, bundle, **asked)
    assert all(one in error.message for one in words), error.message


def test_what_the_hardware_just_can_do_is_done():
    build_plan(DMD, bundle_for(DMD, 1, 50.0, (768, 1024)))
    build_plan(OLED, bundle_for(OLED, 1024, 1000.0))
    build_plan(*many(WDM, 8, channels=8))
    for profile in (OLED, DMD, WDM, IDEAL):
        for exposure in (profile.exposure.min_us, profile.exposure.max_us):
            plan = build_plan(profile, bundle_for(profile, 2, exposure))
            assert plan.exposure_us == pytest.approx(exposure, rel=1e-6)
    with pytest.raises(UsageError, match="order must be one of"):
        build_plan(IDEAL, bundle_for(IDEAL, 2, 10.0), order="random")


def test_the_remedies_of_wrong_light_are_right():
    error = refusal(OLED, bundle_for(OLED, 2, 6000.0))
    assert "too weak by a factor of 2" in error.message
    enough = float(re.search(r"at least (\S+) photoelectrons/s", error.remedy)[1])
    brighter = replace(OLED, projector=replace(OLED.projector, peak_photoelectrons_hz=enough))
    assert build_plan(brighter, bundle_for(OLED, 2, 6000.0)).exposure_us == pytest.approx(3000)
    error = refusal(OLED, bundle_for(OLED, 2, 60.0))
    assert "too bright by a factor of 10" in error.message
    assert "optical density 1.00" in error.remedy


def test_auto_falls_back_where_one_order_has_too_many_slots():
    fast = replace(IDEAL, exposure=replace(IDEAL.exposure, readout_us=1.0))
    fast = replace(fast, projector=replace(fast.projector, pattern_rate_max_hz=1000.0))
    bundle = bundle_for(fast, 20, 10.0)
    assert build_plan(fast, bundle, shots_per_object=50_000).shots_per_cycle == 1
    assert build_plan(fast, bundle, shots_per_object=40_000).shots_per_cycle == 40_000


@pytest.mark.parametrize("peak", [100.0, 500.0])
def test_a_limit_that_training_met_in_float32_is_met(peak: float) -> None:
    """The brightest level of a trained bundle is a float32: at a limit of the exposure its last digits lie beyond it."""
    shipped = load_profile("dmd-qcmos")
    profile = replace(shipped, projector=replace(shipped.projector, peak_photoelectrons_hz=peak))
    top = 0.3  # of 3000 us at 100 photoelectrons/s, and of 600 us, the shortest exposure, at 500
    for scale in (float(np.float32(top)), top * (1 - 5e-8), top * (1 + 5e-8)):
        plan = build_plan(profile, made_bundle(2, 2, table=np.zeros((4, 2)), photons_per_level=scale))
        assert plan.exposure_ticks == round(top / peak * shipped.clock.tick_hz)
    beyond, why = (top * 1.001, "too weak") if peak == 100.0 else (top * 0.999, "too bright")
    with pytest.raises(PlanError, match=why):
        build_plan(profile, made_bundle(2, 2, table=np.zeros((4, 2)), photons_per_level=beyond))
