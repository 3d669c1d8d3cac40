"""Scene files in TOML: what they say comes back as facts, and whatever makes no sense is refused with its place."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from pans.base.errors import ConfigError
from pans_sim.scene.moving import ALL_CHANNELS, Cells, Change, Tape
from pans_sim.scene.scene_file import open_scene
from pans_sim.scene.still import Scene, shipped_scene_files

CELLS = """kind = "cells"
images = "mine.npz"
rate_hz = 1000
velocity_fields_per_s = 2e4
"""
TAPE = """kind = "tape"
bars = 10
pixels_per_bar = 8
speed_bars_per_s = 20_000.0
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    images = np.arange(4 * 5 * 6, dtype=np.uint8).reshape(4, 5, 6)
    np.savez(tmp_path / "mine.npz", images=images, labels=np.array([0, 1, 2, 1]), classes=np.array(["a", "b", "null"]))
    return tmp_path


def written(folder: Path, text: str) -> Path:
    path = folder / "scene.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_cells_scene_comes_back_as_facts(folder: Path) -> None:
    more = 'leave_out = ["null"]\nvelocity_spread = 0.1\noffset_px = 2\nbackground_transmission = 0.01\ngap_every_s = 5\ngap_s = 1\n'
    scene = open_scene(written(folder, CELLS + more))
    assert scene.name == "scene"
    assert scene.moves
    assert isinstance(scene.what, Cells)
    assert scene.what.objects.labels.tolist() == [0, 1, 1]
    assert scene.what.objects.classes == ("a", "b", "null")
    assert scene.n_objects == 3
    assert scene.what == Cells(scene.what.objects, 1000.0, 2e4, 0.1, 2, 0.01, 5.0, 1.0)
    assert scene.changes == ()


def test_a_tape_and_its_file(folder: Path) -> None:
    (folder / "bars.txt").write_text("1011 0\n1")
    scene = open_scene(
        written(folder, TAPE + 'jitter_bars = 0.02\njitter_time_s = 0.01\ntarget = "11"\nfile = "bars.txt"\n')
    )
    assert isinstance(scene.what, Tape)
    assert scene.what.file_bits.tolist() == [1, 0, 1, 1, 0, 1]
    assert (scene.what.bars, scene.what.pixels_per_bar, scene.what.target) == (10, 8, "11")
    assert scene.n_objects == 6
    assert open_scene(written(folder, TAPE)).n_objects == 0


def test_changes_and_a_still_scene(folder: Path) -> None:
    text = """kind = "still"
images = "mine.npz"
[[change]]
at_s = 1
kind = "dark"
factor = 2.0
[[change]]
kind = "hot"
at_s = 2.5
for_s = 3
channel = 7
rate_hz = 1e4
[[change]]
kind = "drift"
at_s = 0
percent_per_s = -1
"""
    scene = open_scene(written(folder, text))
    assert isinstance(scene.what, Scene)
    assert not scene.moves
    assert scene.changes == (
        Change("dark", 1.0, math.inf, ALL_CHANNELS, 2.0),
        Change("hot", 2.5, 3.0, 7, 1e4),
        Change("drift", 0.0, math.inf, ALL_CHANNELS, -1.0),
    )


def test_class_folders_are_pictures_too(folder: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    for name, grey in (("bright", 200), ("dim", 20)):
        (folder / "pictures" / name).mkdir(parents=True)
        for number in range(2):
            image.new("L", (4, 3), grey).save(folder / "pictures" / name / f"{number}.png")
    scene = open_scene(written(folder, CELLS.replace("mine.npz", "pictures")))
    assert isinstance(scene.what, Cells)
    assert scene.what.objects.classes == ("bright", "dim")
    assert scene.what.objects.images.shape == (4, 3, 4)
    assert scene.what.objects.labels.tolist() == [0, 0, 1, 1]
    image.new("L", (5, 3), 0).save(folder / "pictures" / "dim" / "2.png")
    with pytest.raises(ConfigError, match=r"scene.toml:2:1: .*5 x 3 pixels, the first image \(0.png\) has 4 x 3"):
        open_scene(folder / "scene.toml")


@pytest.mark.parametrize("name", shipped_scene_files())
def test_every_shipped_scene_file_opens(name: str) -> None:
    assert open_scene(name).moves


def test_other_names_are_still_scenes() -> None:
    assert open_scene("uniform").what.any_shape  # type: ignore[union-attr]
    with pytest.raises(ConfigError, match="neither a shipped scene nor a file") as caught:
        open_scene("nothing.toml")
    assert "bar-tape" in caught.value.remedy


def test_changes_may_come_with_the_url(folder: Path) -> None:
    text = "dark:at_s=1.5:factor=2,dead:at_s=40:for_s=1e3:channel=3"
    first = Change("dead", 0.0, math.inf, 0, 0.0)
    path = written(folder, TAPE + '[[change]]\nkind = "dead"\nat_s = 0\nchannel = 0\n')
    wanted = (first, Change("dark", 1.5, math.inf, ALL_CHANNELS, 2.0), Change("dead", 40.0, 1000.0, 3, 0.0))
    assert open_scene(path, text).changes == wanted
    assert open_scene("fashion200", text).changes == wanted[1:]
    for wrong, message in [
        ("dark", "change.at_s is missing in a change of kind dark"),
        ("dim:at_s=1", 'change.kind must be "dark" or'),
        ("hot:at_s=x:channel=1:rate_hz=1", "change.at_s must be a number from 0 to 10000000"),
        ("dark:at_s=1:factor=2,", 'change.kind must be "dark" or'),
    ]:
        with pytest.raises(ConfigError, match=message):
            open_scene("fashion200", wrong)


WRONG = [
    ("", r":1:1: kind is missing"),
    ('kind = "cell"', r':1:1: kind must be "still" or "cells" or "tape", found the text "cell"'),
    (CELLS + "rate = 3\n", r":5:1: rate is not a key of a scene of kind cells"),
    (CELLS.replace("rate_hz = 1000\n", ""), r":1:1: rate_hz is missing"),
    (CELLS.replace("1000", "0"), r":3:1: rate_hz must be a number from 0.001 to 1000000, found 0"),
    (CELLS.replace("1000", "5e-324"), r":3:1: rate_hz must be a number from 0.001"),  # a run would never begin
    (CELLS.replace("1000", "nan"), r":3:1: rate_hz must be a number from 0.001"),
    (CELLS.replace("1000", "true"), r":3:1: rate_hz must be .*, found the boolean true"),
    (CELLS + "offset_px = 1.0\n", r":5:1: offset_px must be a whole number from 0 to 64, found 1.0"),
    (CELLS + "offset_px = 5\n", r":2:1: the cells need pictures higher than offset_px = 5, found 5 rows"),
    (CELLS + "gap_every_s = 1\ngap_s = 1\n", r":6:1: gap_s must be less than gap_every_s = 1, found 1"),
    (CELLS + 'leave_out = ["c"]\n', r':5:1: leave_out names "c", the classes are a, b, null'),
    (CELLS + 'leave_out = ["a", "b", "null"]\n', r":5:1: leave_out leaves no picture"),
    (CELLS + 'leave_out = "a"\n', r":5:1: leave_out must be a list of texts"),
    (CELLS.replace("mine.npz", "yours.npz"), r":2:1: scene 'yours.npz': neither a shipped scene nor a file"),
    (CELLS.replace("mine.npz", "uniform"), r":2:1: the cells need pictures higher"),
    (TAPE + 'target = "12"\n', r":5:1: target must be up to 10 digits 0 and 1"),
    (TAPE + "jitter_bars = 0.01\n", r":5:1: jitter_bars needs jitter_time_s"),
    (TAPE + "jitter_bars = 0.3\n", r":5:1: jitter_bars must be a number from 0 to 0.1, found 0.3"),
    (TAPE + 'file = "none.txt"\n', r":5:1: .*none.txt: cannot be read"),
    (TAPE + 'file = "scene.toml"\n', r":5:1: .*must hold 1 to .* digits 0 and 1"),
    (TAPE + "change = 3\n", r":5:1: change must be a list of tables, found 3"),
    (TAPE + "[[change]]\nat_s = 1\n", r":5:1: change.kind is missing"),
    (TAPE + '[[change]]\nat_s = 1\nkind = "dead"\n', r":5:1: change.channel is missing in a change of kind dead"),
    (
        TAPE + '[[change]]\nat_s = 1\nkind = "dead"\nchannel = 1\n[[change]]\nat_s = -1\nkind = "dead"\nchannel = 1\n',
        r":10:1: change.at_s must be a number from 0",
    ),
    (
        TAPE + '[[change]]\nat_s = 1\nkind = "dark"\nrate_hz = 1\n',
        r":8:1: change.rate_hz is not a key of a change of kind dark",
    ),
    ("kind = [", r":1:9: not valid TOML"),
]


@pytest.mark.parametrize(("text", "message"), WRONG)
def test_what_cannot_be_meant_is_refused_with_its_place(folder: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=r"scene\.toml" + message):
        open_scene(written(folder, text))
