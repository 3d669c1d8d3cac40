"""Scene and bundle that do not belong together are refused with the sizes and class names of both."""

from __future__ import annotations

import pytest

from pans.runtime import SHIPPED
from pans.runtime.bundle.model import load_bundle
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
