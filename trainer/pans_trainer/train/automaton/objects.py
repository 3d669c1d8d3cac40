"""What the training of an automaton sees: blocks of objects in an order and a distortion that change from epoch to epoch.

Objects held back set prices and calibrate; no pattern is trained on them. Grey values stay whole numbers, exact in bfloat16 up to 256; the
transmission is floor + gain * grey. Through drawn optics (model/imaging.py) they are transmission / gain with one more column, the light
of dark pattern pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pans.instrument.optics import tolerance_of
from pans.instrument.profile import Profile
from pans_trainer.device import here
from pans_trainer.model.imaging import DrawnOptics
from pans_trainer.options import AutomatonOptions
from pans_trainer.tasks.changes import DISTORT_STREAM, distorted, shifted
from pans_trainer.tasks.registry import Objects, Task

HELD_BACK_PART = 12  # one in 12 training objects, the last ones
ORDER_STREAM = 0xA07
HELD_BACK_DRAW = (1 << 62) - 1  # of optics; beyond all epochs


@dataclass(frozen=True, slots=True)
class Block:
    """Some objects: `grey` (objects, pixels) in the type of the matrix products, `one_hot` (classes, objects) of labels, or soft."""

    grey: Tensor
    one_hot: Tensor

    def __len__(self) -> int:
        return len(self.grey)


class TrainingObjects:
    """The training objects of a task: `epoch` gives those to fit, `held_back` the others, in blocks.

    `gain` and `floor` turn grey values into the transmission of the profile's modulator. By `options` all images move by whole pixels,
    anew in every epoch, those held back once; epochs take the images and their distorted copies in turn, and draw optics anew.
    """

    def __init__(self, task: Task, profile: Profile, options: AutomatonOptions, held_back: int = 0) -> None:
        n_back = held_back or max(1, len(task.train) // HELD_BACK_PART)
        n_fit = len(task.train) - n_back
        if n_fit < 1:
            raise ValueError(f"{n_back} of {len(task.train)} training objects held back, allowed: all but one")
        self.fitted = task.train.first(n_fit)  # as they are, in the order of the file
        self._back = task.train.take(slice(n_fit, None))
        self.n_classes, self.n_fit, self.n_pixels = len(task.classes), n_fit, task.image_shape[0] * task.image_shape[1]
        self.image_shape = task.image_shape
        modulator = profile.object_modulator
        self._levels = 256 if modulator is None else min(256, modulator.levels)
        self._black = profile.min_transmission
        self.gain = (1.0 - self._black) / (self._levels - 1)
        self._seed, self._options = options.seed, options
        self._optics = None
        if options.optics is not None:
            self._optics = DrawnOptics(tolerance_of(options.optics), task.image_shape, options.seed)
        self.floor = self._black if self._optics is None else 0.0  # which drawn optics show like all other light
        self._targets: NDArray[np.float32] | None = None

    def soften(self, answers: NDArray[np.float32], weight: float) -> None:
        """Give every object to fit class probabilities for its label: `weight` of `answers` (objects, classes), of the label the rest."""
        labels = np.eye(self.n_classes, dtype=np.float32)[self.fitted.labels]
        self._targets = weight * answers + np.float32(1.0 - weight) * labels

    def wide(self, objects: Objects) -> Tensor:
        """Return the grey values of any objects of the task on perfect optics, float64 (objects, pixels), as blocks have them."""
        grey = torch.from_numpy(self._grey(objects.images).astype(np.float64))
        if self._optics is not None:
            grey = torch.cat([grey + self._black / self.gain, torch.zeros(len(grey), 1, dtype=torch.float64)], dim=1)
        return here(grey)

    def epoch(self, number: int, size: int, dtype: torch.dtype, plain: bool = False) -> list[Block]:
        """Return the objects to fit in an order of their own, moved, and distorted unless `plain`; the last block may be smaller."""
        random = np.random.default_rng([ORDER_STREAM, self._seed, number])
        order = random.permutation(self.n_fit)
        objects = self._moved(self.fitted if plain else self._copied(number), number)
        targets = None if self._targets is None else self._targets[order]
        return list(self._blocks(objects.take(order), size, dtype, targets, draw=number))

    def held_back(self, size: int, dtype: torch.dtype) -> list[Block]:
        """Return the objects held back, through moves and optics that no epoch has drawn."""
        return list(self._blocks(self._moved(self._back, HELD_BACK_DRAW), size, dtype, draw=HELD_BACK_DRAW))

    def _copied(self, number: int) -> Objects:
        objects, way = self.fitted, self._options
        version = number % ((way.copies or 0) + 1)
        if not version:
            return objects
        return Objects(distorted(objects.images, [DISTORT_STREAM, self._seed, version], way.strength), objects.labels)

    def _moved(self, objects: Objects, number: int) -> Objects:
        return shifted(objects, self._options.shift_px, self._options.offset_px, self._seed + 1000 * number)

    def _grey(self, images: np.ndarray) -> np.ndarray:
        flat = images.reshape(len(images), -1)
        if self._levels == 256:
            return np.ascontiguousarray(flat)
        table = np.rint(np.arange(256) / 255.0 * (self._levels - 1)).astype(np.uint8)
        return np.asarray(table[flat])

    def _shown(self, images: np.ndarray, draw: int) -> Tensor:
        """Grey values of images, or what optics of that number of draw show of them in the same unit."""
        grey = torch.from_numpy(self._grey(images).copy())
        return grey if self._optics is None else self._optics.through(grey.float() + self._black / self.gain, draw)

    def _blocks(
        self, objects: Objects, size: int, dtype: torch.dtype, targets: NDArray[np.float32] | None = None, *, draw: int
    ) -> Iterator[Block]:
        grey, labels = self._shown(objects.images, draw), objects.labels
        for first in range(0, len(labels), size):
            part = grey[first : first + size].clone()
            if targets is None:
                one_hot = torch.zeros(self.n_classes, len(part))
                one_hot[here(torch.from_numpy(labels[first : first + size])), torch.arange(len(part))] = 1.0
            else:
                one_hot = here(torch.from_numpy(np.ascontiguousarray(targets[first : first + size].T)))
            yield Block(here(part).to(dtype), one_hot)
