"""Small trainings that several test files share: a task, machines with random patterns, short fits."""

import importlib.util
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from tree import ROOT

from pans_trainer.tasks.registry import Objects, Task


@pytest.fixture
def short_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last stage of a training takes 1500 steps however small the task is; tests that ask for no good head take 30."""
    from pans_trainer.train.gradient import head_fit

    monkeypatch.setattr(head_fit, "STEPS", 30)


def bars_task(n: int = 1200, seed: int = 0) -> Task:
    """Four classes on 6 x 6 pixels: the bright bar stands in one of four columns, over noise."""
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 4, n)
    images = rng.integers(0, 50, (n, 6, 6), dtype=np.uint8)
    images[np.arange(n), :, labels + 1] = rng.integers(150, 256, (n, 6), dtype=np.uint8)
    part = n * 2 // 3
    train, test = Objects(images[:part], labels[:part]), Objects(images[part:], labels[part:])
    return Task("bars", ("a", "b", "c", "d"), train, test, "0" * 64, "the test part of the data")


def columns_task(n_train: int, n_test: int, n_classes: int, side: int, name: str = "columns", seed: int = 0) -> Task:
    """On `side` x `side` pixels a bright column names the class, over noise; classes are letters."""
    rng, n = np.random.default_rng(seed), n_train + n_test
    labels = rng.permutation(np.arange(n) % n_classes)
    images = rng.integers(0, 60, (n, side, side), dtype=np.uint8)
    images[np.arange(n), :, labels * side // n_classes] = 230
    train, test = (Objects(images[at], labels[at]) for at in (slice(n_train), slice(n_train, n)))
    return Task(name, tuple("abcdefghij"[:n_classes]), train, test, "0" * 64, "made here")


def spots_task(n_train: int, n_test: int) -> Task:
    """A bright round field of any power on 12 x 12 pixels; half of them with a bright or dark spot somewhere near the middle."""
    return Task("spots", ("clean", "spot"), _spots(n_train, 0), _spots(n_test, 1), "0" * 64, "", light="field")


def _spots(n: int, seed: int, side: int = 12) -> Objects:
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 2, n)
    y, x = np.mgrid[:side, :side] - (side - 1) / 2
    field = np.exp(-(x**2 + y**2) / 30) * rng.uniform(0.5, 0.8, (n, 1, 1))
    cy, cx = rng.uniform(-2, 2, (2, n, 1, 1))
    spot = np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 4) * rng.choice([-0.6, 0.4], (n, 1, 1))
    field = field * (1 + spot * labels[:, None, None]) + 0.004 * rng.normal(size=field.shape)
    return Objects(np.rint(255 * field.clip(0, 1)).astype(np.uint8), labels)


def kept_task(path: Path, task: Task) -> Path:
    """Write both parts of `task` as a .npz file and return its path."""
    arrays = {"train_images": task.train.images, "train_labels": task.train.labels}
    np.savez(path, **arrays, test_images=task.test.images, test_labels=task.test.labels)
    return path


def random_machine(seed: int = 0, bits: bool = False, shared: bool = False) -> Any:
    """Three levels of 1, 2 and 3 states on 5 pixels, four classes; a leaf behind level 0, two behind level 1, five behind level 2."""
    import torch

    from pans_trainer.train.automaton.machine import Bits, Grey, Level, Machine

    random = torch.Generator().manual_seed(seed)
    successors = [[[0], [1]], [[2, 0], [1, 4]], [[0, 2, 4], [1, 3, 0]]]
    one = torch.full((1, 1), -1.0, dtype=torch.float64)
    levels = []
    for number, edges in enumerate(successors):
        shape = len(edges[0]), 5
        drawn = torch.randn(shape, generator=random, dtype=torch.float64)
        if bits:
            own = torch.randn((shape[0], 1), generator=random, dtype=torch.float64) - 1
            light: Any = Bits(drawn, one if shared else own)
        else:
            light = Grey(drawn * 0.6)
        if number == 0:
            edges = [[2], [0]]  # a leaf, and a state
        levels.append(Level(light, torch.tensor(edges)))
    counts = [torch.rand((n, 4), generator=random, dtype=torch.float64) + 0.1 for n in (1, 2, 5)]
    return Machine(levels, counts)


def assert_slope(tensor: Any, loss: Callable[[], float], step: float = 1e-6) -> None:
    """Hold `tensor.grad` against differences of `loss`, which is asked with one value of `tensor` moved at a time."""
    gradient = tensor.grad.clone()
    for index in np.ndindex(*tensor.shape):
        there = tensor[index].item()
        tensor[index] = there + step
        above = loss()
        tensor[index] = there - step
        below = loss()
        tensor[index] = there
        assert float(gradient[index]) == pytest.approx((above - below) / (2 * step), rel=1e-5, abs=1e-8)


SCRIPT = ROOT / "docs/tutorial/practice_images.py"


def practice_images() -> ModuleType:
    """Return the script as a module; it needs Pillow."""
    spec = importlib.util.spec_from_file_location("practice_images", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def practice_folder(folder: Path, name: str, number: int, seed: int = 1) -> Path:
    """Draw the first `number` images of a set into `folder` and return it."""
    practice_images().draw_folder(name, folder, seed, number)
    return folder
