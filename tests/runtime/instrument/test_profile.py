"""Profiles: the shipped ones are complete, a wrong line is named with its place and remedy, a template has every key."""

import dataclasses
import hashlib
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tree import ROOT

from pans.base.errors import ConfigError
from pans.base.files.toml_file import key_positions, position_of, read_toml
from pans.instrument.profile import MAX_PROFILE_BYTES, load_profile, parse_profile, profile_template, shipped_profiles
from pans.instrument.profile_schema import SCHEMA

GOOD = """\
[profile]
name = "lab"
description = "a profile for tests"
mode = "sequential"
measure = ["detector.dark_rate_hz"]

[projector]
kind = "OLED"
width_px = 64
height_px = 32
levels = 16
pixel_pitch_um = 50
pattern_rate_max_hz = 60.0
pattern_memory = 100
peak_photoelectrons_hz = 1e3

[object]
contrast = 50.0
levels = 256

[optics]
psf_px = 0.2

[detector]
kind = "SPAD"
channels = 1
efficiency = 0.5
dark_rate_hz = 20.0

[exposure]
min_us = 100.0
max_us = 1000.0
readout_us = 10.0

[clock]
tick_hz = 1_000_000

[timing]
decision_deadline_us = 1000.0
lease_ms = 500

[sources]
"detector.efficiency" = "data sheet"
"""


def edited(section: str, line: str, text: str = GOOD) -> str:
    """`text` with `line` in a section, in the place of the line that sets the same key; a line without a value removes that."""
    key = line.split(" =")[0].strip()
    head, _, body = text.partition(f"[{section}]\n")
    lines = body.splitlines()
    end = lines.index("") if "" in lines else len(lines)
    kept = [one for one in lines[:end] if one.split(" =")[0] != key]
    return head + "\n".join([f"[{section}]", *kept, *([line] if "=" in line else []), *lines[end:]]) + "\n"


def fault(text: str) -> ConfigError:
    with pytest.raises(ConfigError) as caught:
        parse_profile(text, "lab.toml")
    return caught.value


def line_of(text: str, start: str) -> int:
    return next(number for number, line in enumerate(text.splitlines(), 1) if line.startswith(start))


def test_reads_a_good_profile():
    profile = parse_profile(GOOD, "lab.toml")
    assert profile.name == "lab"
    assert profile.projector.pixel_pitch_um == 50.0
    assert isinstance(profile.projector.pixel_pitch_um, float)  # a whole number is a number
    assert profile.clock.tick_hz == 1_000_000
    assert isinstance(profile.clock.tick_hz, int)
    assert profile.sources == {"detector.efficiency": "data sheet"}
    assert profile.measure == ("detector.dark_rate_hz",)
    assert profile.min_transmission == 0.02
    assert profile.detector.read_noise_e == profile.detector.crosstalk_probability == 0.0  # not declared: absent
    assert profile.text == GOOD
    assert profile.sha256 == hashlib.sha256(GOOD.encode()).hexdigest()


@pytest.mark.parametrize(
    ("section", "line", "words"),
    [
        ("profile", 'mode = "serial"', ['must be "sequential" or "parallel"', 'found the text "serial"']),
        ("profile", 'name = "../up"', ["letters, digits", "../up"]),
        ("profile", 'measure = "detector.dark_rate_hz"', ["list of keys"]),
        ("profile", 'measure = ["detector.dead_time_ns"]', ["not a key of this profile"]),
        ("projector", "kind = 3", ["text in quotes", "found 3"]),
        ("projector", "levels = 1", ["a whole number from 2 to 65536", "found 1"]),
        ("projector", "levels = true", ["a whole number", "found the boolean true"]),
        ("projector", "width_px = " + "9" * 400, ["an enormous whole number"]),
        ("projector", "pattern_rate_max_hz = 0", ["above 0", "found 0"]),
        ("projector", 'pixel_pitch_um = "50"', ["a number", 'the text "50"']),
        ("object", "contrast = 1.0", ["above 1 and at most", "or inf"]),
        ("object", "contrast = nan", ["found nan"]),
        ("optics", "psf_px = -1", ["must be a number from 0 to 1000"]),
        ("optics", "psf_tolerance_px = 0.3", ["must be at most optics.psf_px - 0 = 0.2, found 0.3"]),
        ("optics", "scale_tolerance = 0.9", ["must be at most"]),
        ("optics", "black = 0.1", ["is not a key"]),
        ("optics", "source_fluctuation = 0.5", ["from 0 to 0.3"]),
        ("optics", "dark_pixel = 1", ["from 0 to 0.99"]),
        ("exposure", "max_us = inf", ["found inf"]),
        ("exposure", "   min_us = 2000.0", ["at most exposure.max_us = 1000", "found 2000"]),
        ("exposure", "min_us = 9.0", ["at least 10 ticks = 10 us", "found 9"]),
        ("clock", "tick_hz = 1e6", ["a whole number", "found 1000000.0"]),
        ("timing", "lease_ms = 1", ["above timing.decision_deadline_us = 1 ms", "found 1"]),
        ("timing", "lease_ms = 1979-05-27", ["found a date"]),
        ("detector", "efficiency = 0", ["above 0 and at most 1", "found 0"]),
        ("detector", "efficiency = true", ["a number", "found the boolean true"]),
        ("detector", "dark_rate_hz = -0.1", ["from 0 to", "found -0.1"]),
        ("detector", "channels = 5", ["must be from 1 to 4 in sequential mode", "found 5"]),
        ("detector", "threshold_e = 0.0", ["above 0"]),
        ("detector", "read_noise_e = -0.1", ["from 0 to"]),
        ("detector", "afterpulse_probability = 1.5", ["from 0 to 1", "found 1.5"]),
        ("detector", "crosstalk_probability = 0.1", ["must be 0 with 1 channel"]),
        (
            "detector",
            "dead_time_ns = 110001",
            ["at most exposure.min_us + exposure.readout_us = 110000 ns", "found 110001"],
        ),
        (
            "detector",
            'dead_time_kind = "extended"',
            ['must be "non-paralysable" or "paralysable"', 'found the text "extended"'],
        ),
        ("detector", "afterpulse_time_us = 0.0", ["above 0"]),
        ("detector", "afterpulse_time_us = 5.0", ["needs afterpulse_probability above 0", "found 0"]),
        ("detector", "crosstalk_further = [0.01]", ["at most 0 numbers", "1 channels, found 1"]),
        ("detector", "crosstalk_further = [2.0]", ["a list of numbers from 0 to 1"]),
        ("detector", "crosstalk_further = 0.01", ["a list of numbers from 0 to 1, found 0.01"]),
        ("detector", "telegraph_share = 0.1", ["needs telegraph_offset_e and telegraph_time_s"]),
        ("detector", "threshold_drift_e_per_hour = 0.1", ["needs read_noise_e above 0"]),
        ("detector", "timing_jitter_ns = 1.0", ["must be 0 in sequential mode"]),
        ("detector", 'between_exposures = "free"', ['must be "gated" or "free-running"', 'found the text "free"']),
        ("sources", '"detector.efficency" = "x"', ["detector.efficency", "not a key"]),
        ("sources", '"detector.efficiency" = ""', ["must be text"]),
        ("sources", "detector.dark_rate_hz = 3", ["found a table"]),
    ],
)
def test_a_wrong_value_is_named_with_its_place(section: str, line: str, words: list[str]) -> None:
    text = edited(section, line)
    error = fault(text)
    column = len(line) - len(line.lstrip()) + 1
    assert error.message.startswith(f"lab.toml:{line_of(text, line)}:{column}: ")
    for word in (line.split(" =")[0].strip().split(".")[0].strip('"'), *words):
        assert word in error.message


def test_the_longest_dead_time_is_allowed() -> None:
    assert parse_profile(edited("detector", "dead_time_ns = 110000"), "lab.toml").detector.dead_time_ns == 110000


def test_parallel_needs_channels():
    text = edited("profile", 'mode = "parallel"')
    assert "at least 2 in parallel mode" in fault(text).message
    assert parse_profile(edited("detector", "channels = 2", text), "lab.toml").detector.channels == 2


@pytest.mark.parametrize(
    ("line", "message", "remedy"),
    [
        ("dead_time_us = 3", "the unit is part of the name, and this one is dead_time_ns", "convert the value to ns"),
        ("dead_time = 3", "the unit is part of the name", "convert the value to ns"),
        ("eficiency = 0.5", "[detector] takes kind, channels, efficiency", "did you mean efficiency?"),
        ("lease_ms = 5", "not a key", "belongs in [timing]"),
        ("zzz = 1", "not a key", "docs/reference/profiles.md"),
    ],
)
def test_an_unknown_key_is_an_error_with_a_suggestion(line, message, remedy):
    text = edited("detector", line)
    error = fault(text)
    assert error.message.startswith(f"lab.toml:{line_of(text, line)}:1: detector.{line.split(' ')[0]} is not a key")
    assert message in error.message
    assert remedy in error.remedy


def test_an_unknown_section_is_an_error():
    error = fault(GOOD + "[detectors]\n")
    assert error.message.startswith(f"lab.toml:{line_of(GOOD, '[sources]') + 2}:1: detectors ")
    assert "[detector]" in error.remedy
    assert "[profile]" in fault('name = "lab"\n' + GOOD).remedy


REQUIRED = [
    f"{section}.{key}"
    for section, table in tomllib.loads(GOOD).items()
    for key in table
    if section not in ("sources", "optics")
]


@pytest.mark.parametrize("key", sorted(set(REQUIRED) - {"profile.description", "profile.measure"}))
def test_a_missing_key_is_named(key):
    section, name = key.split(".")
    error = fault(edited(section, name))
    assert error.message == f"lab.toml:{line_of(GOOD, f'[{section}]')}:1: {key} is missing"
    assert name in error.remedy


@pytest.mark.parametrize("section", ["profile", "projector", "detector", "exposure", "clock", "timing"])
def test_a_missing_section_is_named(section):
    kept = "\n".join(block for block in GOOD.split("\n\n") if not block.startswith(f"[{section}]"))
    assert f"section [{section}] is missing" in fault(kept).message


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("[profile]\nname = \n", "2:8"),
        ("[profile]\nname = 'lab'\nname = 'lab'\n", "3:"),
        ("[profile]\nname = 'lab", "2:"),
        ("[profile]\nx = [[1,\n", "3:1"),
    ],
)
def test_text_that_is_not_toml_is_named_with_its_place(text, where):
    error = fault(text)
    assert error.message.startswith(f"lab.toml:{where}")
    assert "not valid TOML" in error.message


@pytest.mark.parametrize(
    "text",
    ["x = " + "9" * 5000, "x = " + "[" * 100_000 + "]" * 100_000, edited("object", "contrast = " + "9" * 400)],
    ids=["digits", "nesting", "number"],
)
def test_what_has_no_end_is_an_error_not_a_crash(text):
    assert fault(text).message.startswith("lab.toml:")


def test_a_file_that_is_too_large_or_not_utf8_is_refused(tmp_path):
    path = tmp_path / "lab.toml"
    path.write_bytes(GOOD.encode() + b"#" * MAX_PROFILE_BYTES)
    with pytest.raises(ConfigError, match="at most 1048576"):
        load_profile(path)
    path.write_bytes(GOOD.encode() + b"# caf\xe9\n")
    with pytest.raises(ConfigError, match=rf"lab\.toml:{GOOD.count(chr(10)) + 1}:6: byte 0xe9 is not UTF-8"):
        load_profile(path)


def test_loads_a_path_and_ignores_the_line_ends_of_the_system(tmp_path):
    path = tmp_path / "lab.toml"
    path.write_bytes(GOOD.replace("\n", "\r\n").encode("utf-8-sig"))
    assert load_profile(path) == load_profile(str(path)) == parse_profile(GOOD, "lab.toml")


def test_an_unknown_name_lists_the_shipped_profiles():
    with pytest.raises(ConfigError, match=", ".join(shipped_profiles())) as caught:
        load_profile("oled-qcmso")
    assert "did you mean oled-qcmos?" in caught.value.remedy


@pytest.mark.parametrize("name", shipped_profiles())
def test_every_figure_of_a_shipped_profile_has_a_source_or_is_to_be_measured(name):
    profile = load_profile(name)
    assert profile.name == name
    assert profile.description
    for section, table in tomllib.loads(profile.text).items():
        for key, value in table.items():
            if isinstance(value, (int, float)):
                assert f"{section}.{key}" in {*profile.sources, *profile.measure}


@pytest.mark.parametrize("name", shipped_profiles())
def test_every_shipped_key_is_explained(name):
    page = (ROOT / "docs" / "reference" / "profiles.md").read_text(encoding="utf-8")
    for section, table in tomllib.loads(load_profile(name).text).items():
        assert f"[{section}]" in page
        if section != "sources":
            assert [key for key in table if f"`{key}`" not in page] == []


def test_positions_are_found_among_all_that_toml_allows():
    text = """# [no.section]
"quoted key" = 1
a . b = '''
[not.a.section]
c = 1'''
list = [ # ]
  "]", '[',
]   # comment
inline = { x = 1, y = "}" }
 [ s . "t.u" ] # after
    v = \"\"\"
w = 1 \\\"\"\"\"
\t\\u0061 = 2
[[many]]
k = 1
[[many]]
k = 2
""".replace("\\u0061", '"\\u0061"')
    tables, found = tomllib.loads(text), key_positions(text)
    assert found == {
        ("quoted key",): (2, 1),
        ("a",): (3, 1),
        ("a", "b"): (3, 1),
        ("list",): (6, 1),
        ("inline",): (9, 1),
        ("s", "t.u"): (10, 2),
        ("s", "t.u", "v"): (11, 5),
        ("s", "t.u", "a"): (13, 2),
        ("many",): (14, 1),
        ("many", "0"): (14, 1),
        ("many", "0", "k"): (15, 1),
        ("many", "1"): (16, 1),
        ("many", "1", "k"): (17, 1),
    }
    assert set(tables["s"]["t.u"]) == {"v", "a"}
    assert position_of(("inline", "x"), found) == (9, 1)
    assert position_of(("nowhere",), found) == (1, 1)


@given(st.text(alphabet="ab.=\"'[]{}#\n\\ 1,", max_size=60))
def test_any_text_is_read_or_refused_and_positions_cover_every_table(text):
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        assert fault(text).message.startswith("lab.toml:")
        return
    found = key_positions(text)
    assert {path[0] for path in found if path} == set(tables)


def test_a_key_of_too_many_parts_is_refused_before_it_takes_minutes() -> None:
    with pytest.raises(ConfigError, match=r"long\.toml:2:1: .*100 dots"):
        read_toml("x = 1\n" + "a." * 100_000, "long.toml")


OPTICS = """
[optics]
psf_px = 0.6
psf_tolerance_px = 0.1
right_px = 0.25
shift_tolerance_px = 1
rotation_tolerance_deg = 2.0
dark_pixel = 0.002
gain_tolerance = 0.05
"""


def test_a_profile_states_its_optics_and_how_far_they_may_be_off() -> None:
    text = load_profile("dmd-spad").text
    profile = parse_profile(text.replace("\n[detector]", OPTICS + "\n[detector]", 1), "lab.toml")
    spans = profile.optics.tolerance().as_dict()
    assert spans == {
        "right_px": [-0.75, 1.25],
        "down_px": [-1.0, 1.0],
        "rotation_deg": [-2.0, 2.0],
        "scale": [1.0, 1.0],
        "psf_px": [pytest.approx(0.5), pytest.approx(0.7)],
        "black": [0.002, 0.002],
        "gain": [0.95, 1.05],
    }
    stated = profile.imaging()
    assert (stated.right_px, stated.psf_px, stated.black, stated.gain) == (0.25, pytest.approx(0.6), 0.002, 1.0)


def test_a_flat_field_stands_in_a_file_beside_the_profile(tmp_path: Path) -> None:
    text = load_profile("dmd-spad").text
    path = tmp_path / "lab.toml"
    path.write_text(text.replace("\n[detector]", '\n[optics]\nflat_field_file = "flat.npz"\n\n[detector]', 1))
    with pytest.raises(ConfigError, match="not a readable flat field"):
        load_profile(path).imaging()
    flat = np.array([[0.5, 1.5], [0.75, 1.25]])
    np.savez(tmp_path / "flat.npz", flat=flat)
    found = load_profile(path).imaging().flat
    assert found is not None
    np.testing.assert_array_equal(found, flat)
    np.savez(tmp_path / "flat.npz", flat=2 * flat)
    with pytest.raises(ConfigError, match="flat has the mean 2"):
        load_profile(path).imaging()


@pytest.mark.parametrize("base", shipped_profiles())
def test_a_template_has_the_figures_of_its_base(base: str) -> None:
    made, shipped = parse_profile(profile_template("my-lab", base), "my-lab.toml"), load_profile(base)
    own = {"name", "description", "measure", "sources", "text"}
    for field in dataclasses.fields(shipped):
        if field.name not in own:
            assert getattr(made, field.name) == getattr(shipped, field.name), field.name
    assert (made.name, made.sources) == ("my-lab", {})


def test_a_template_explains_every_key_with_its_allowed_values() -> None:
    lines = profile_template("my-lab", "oled-qcmos").split("\n")
    keys = [at for at, line in enumerate(lines) if re.match(r"(# )?[a-z_]+ =", line) and not line.startswith("measure")]
    assert len(keys) == sum(len(keys) for keys in SCHEMA.values())
    for at in keys:
        assert re.fullmatch(r"# .+ \[.+\]", lines[at - 1]), lines[at]


def test_a_text_cannot_leave_its_quotes() -> None:
    with pytest.raises(ConfigError, match=r"profile\.name must be"):
        parse_profile(profile_template('x"\n[clock]\\', "ideal"), "x.toml")
