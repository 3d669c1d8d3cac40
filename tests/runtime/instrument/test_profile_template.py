"""The commented template: complete, readable, and with the figures of the profile that it is made from."""

from __future__ import annotations

import dataclasses
import re

import pytest

from pans.runtime.errors import ConfigError
from pans.runtime.instrument.profile import load_profile, parse_profile, shipped_profiles
from pans.runtime.instrument.profile_schema import SCHEMA
from pans.runtime.instrument.profile_template import MEANINGS, profile_template


def test_every_key_has_its_meaning_and_no_other() -> None:
    assert set(MEANINGS) == {f"{section}.{key}" for section, keys in SCHEMA.items() for key in keys}


@pytest.mark.parametrize("base", shipped_profiles())
def test_the_template_has_the_figures_of_its_base(base: str) -> None:
    made, shipped = parse_profile(profile_template("my-lab", base), "my-lab.toml"), load_profile(base)
    own = {"name", "description", "measure", "sources", "text"}
    for field in dataclasses.fields(shipped):
        if field.name not in own:
            assert getattr(made, field.name) == getattr(shipped, field.name), field.name
    assert (made.name, made.sources) == ("my-lab", {})
    assert set(made.measure) <= set(MEANINGS)


def test_each_key_has_a_comment_with_its_allowed_values() -> None:
    lines = profile_template("my-lab", "oled-qcmos").split("\n")
    keys = [at for at, line in enumerate(lines) if re.match(r"(# )?[a-z_]+ =", line) and not line.startswith("measure")]
    assert len(keys) == sum(len(keys) for keys in SCHEMA.values())
    for at in keys:
        assert re.fullmatch(r"# .+ \[.+\]", lines[at - 1]), lines[at]


def test_a_text_cannot_leave_its_quotes() -> None:
    with pytest.raises(ConfigError, match=r"profile\.name must be"):
        parse_profile(profile_template('x"\n[clock]\\', "ideal"), "x.toml")
