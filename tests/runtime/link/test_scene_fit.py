"""Scene and bundle that do not belong together are refused with the sizes and class names of both."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pans.runtime import SHIPPED
from pans.runtime.bundle.model import load_bundle
from pans.runtime.cli import main
from pans.runtime.errors import UsageError
from pans.runtime.link.fit import TEXT_MAX_BYTES, check_scene, scene_facts

FASHION = load_bundle(SHIPPED / "fashion10.pans")[0]


def test_what_belongs_together_is_taken() -> None:
    for facts in (
        {},
        scene_facts(None, ()),
        scene_facts((28, 28), ()),
        scene_facts(None, FASHION.classes),
        scene_facts((28, 28), FASHION.classes),
        scene_facts((28, 28), [str(number) for number in range(10)]),  # as many without names
    ):
        check_scene(facts, FASHION)


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
        check_scene({"scene": "s", **scene_facts(shape, classes)}, FASHION)
    assert words in caught.value.message
    assert "the bundle has 28 x 28 pixels and the classes T-shirt/top, Trouser" in caught.value.message


def test_names_of_any_length_fit_into_a_welcome() -> None:
    for classes in (["é" * 300] * 3, [str(i) for i in range(10_000)], ["a\nb", "\ud800"]):
        assert all(len(str(fact).encode()) <= 256 for fact in scene_facts((1, 2), classes).values())
    assert TEXT_MAX_BYTES < 256


def test_a_run_is_refused_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    np.savez("s.npz", images=np.zeros((3, 14, 14), np.uint8), labels=np.arange(3) % 2, classes=np.array(["a", "b"]))
    device = "sim:oled-qcmos?pace=fast&scene=s.npz"
    assert main(["run", "fashion10", "--device", device, "--decisions", "1", "--out", "new"]) == 2
    said = capsys.readouterr().err
    assert "do not belong together: the scene has 14 x 14 pixels and the classes a, b" in said
    assert "link was lost" not in said
    assert [path.name for path in tmp_path.iterdir()] == ["s.npz"]
