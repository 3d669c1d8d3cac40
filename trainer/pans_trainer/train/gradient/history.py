"""How a training went: figures of every epoch, and the patterns after some of them. SIMULATED, of the training objects.

`History` (`pans train --history DIR`) writes `history.json` and its pictures (extra `plot`). `follow` trains one run epoch by epoch and
measures the accuracy on training and held-out objects in between, with random numbers of its own: the training gives what `train` gives.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pans.base.files import make_folder, write_file
from pans.instrument.profile import Profile
from pans_trainer.figures import new_figure, save_figure
from pans_trainer.model.encoders import ActiveIllumination
from pans_trainer.options import Options
from pans_trainer.tasks.registry import Task

from .data import CHUNK, TrainingData, encoder_input
from .loop import EpochReport, Run, Trained

TRAINING_OBJECTS = 5000  # by which the accuracy on training objects is judged: the first ones
FIRST = 200
STEPS_SHOWN = 8
PATTERNS_SHOWN = 8
QUANTITIES = (
    ("loss", "loss"),
    ("clicks", "clicks per decision"),
    ("photons", "photons per decision"),
    ("illumination", "illumination per decision"),
)


class History:
    """The reports of all epochs; `write` makes the file and the pictures."""

    def __init__(self, epochs: int) -> None:
        self.epochs: list[EpochReport] = []
        self.patterns: dict[int, NDArray[np.float32]] = {}  # of the first restart, after that many epochs
        self._last = epochs
        before = max(1, epochs - 1)
        self._wanted = {round(math.exp(math.log(before) * i / (STEPS_SHOWN - 1))) for i in range(STEPS_SHOWN)}

    def add(self, report: EpochReport) -> None:
        """Note one epoch."""
        self.epochs.append(replace(report, patterns=report.patterns[:0]))
        if report.restart == 0 and report.epoch in self._wanted:
            self.patterns[report.epoch] = report.patterns

    def write(
        self, folder: Path, last: NDArray[np.floating] | None, image_shape: tuple[int, int], *, force: bool = False
    ) -> list[Path]:
        """Write history.json, curves.png and evolution.png; `last` (d_f, pixels) are the patterns in the end."""
        if last is not None:
            self.patterns[self._last] = np.asarray(last, np.float32)
        written = write_course(folder, self.epochs, {"patterns_at": sorted(self.patterns)}, force=force)
        if self.patterns:
            draw_evolution(folder / "evolution.png", self.patterns, image_shape, force=force)
            written.append(folder / "evolution.png")
        return written


def write_course(
    folder: Path, reports: Sequence[Any], more: Mapping[str, Any] = MappingProxyType({}), *, force: bool = False
) -> list[Path]:
    """Write history.json (`reports` of either kind of training, and `more`) and curves.png into `folder`; return both paths."""
    make_folder(folder)
    facts = {"simulated": True, "epochs": [asdict(report) for report in reports], **more}
    for epoch in facts["epochs"]:
        epoch.pop("patterns", None)
    write_file(folder / "history.json", (json.dumps(facts, indent=1) + "\n").encode(), force=force)
    draw_curves(folder / "curves.png", reports, force=force)
    return [folder / "history.json", folder / "curves.png"]


def draw_curves(path: Path, reports: Sequence[Any], *, force: bool = False) -> None:
    """Draw loss, clicks, photons and illumination over the epochs (of an automaton: levels, then epochs), one line per restart."""
    figure, axes = new_figure(width=12.0, height=3.6, panels=len(QUANTITIES))
    for axis, (name, label) in zip(axes, QUANTITIES):
        restarts = [getattr(report, "restart", 0) for report in reports]
        for restart in sorted(set(restarts)):
            # starts and restarts run through the same epochs again: the order is that of the training
            values = [getattr(report, name) for report, own in zip(reports, restarts) if own == restart]
            axis.plot(range(1, len(values) + 1), values, color="C0", alpha=0.9 if restart == 0 else 0.4)
        axis.set(xlabel="epochs trained", ylabel=label)
        axis.grid(alpha=0.3)
    stages: dict[str, int] = {}
    for index, report in enumerate(reports):
        stages.setdefault(report.stage, index)
    for stage, begin in stages.items():
        axes[0].axvline(begin, color="0.7", lw=0.8)
        axes[0].annotate(stage, (begin, 1.0), xycoords=("data", "axes fraction"), fontsize=7, rotation=90, va="top")
    figure.suptitle("SIMULATED, training objects", fontsize=9)
    save_figure(figure, path, force=force)


def draw_evolution(
    path: Path, patterns: dict[int, NDArray[np.float32]], image_shape: tuple[int, int], *, force: bool = False
) -> None:
    """Draw the first patterns (rows) after some epochs (columns), each picture up to its own brightest pixel."""
    from matplotlib import pyplot

    epochs = sorted(patterns)
    rows = min(PATTERNS_SHOWN, len(patterns[epochs[0]]))
    size = (1.15 * len(epochs) + 0.4, 1.15 * rows + 0.6)
    figure, axes = pyplot.subplots(rows, len(epochs), figsize=size, layout="constrained", squeeze=False)
    for column, epoch in enumerate(epochs):
        axes[0, column].set_title(f"{epoch}", fontsize=8)
        for row in range(rows):
            axes[row, column].imshow(patterns[epoch][row].reshape(image_shape), cmap="magma", vmin=0)
            axes[row, column].set(xticks=[], yticks=[])
            axes[row, 0].set_ylabel(f"pattern {row}", fontsize=8)
    figure.suptitle("patterns after so many epochs, each up to its own brightest pixel (SIMULATED)", fontsize=9)
    save_figure(figure, path, force=force)


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """Columns of figures over all epochs, the patterns (d_f, pixels) after some of them, and the finished model.

    Columns are the state after each epoch by one draw of clicks (K = 1), five digits each: accuracies in %, the light in the mean over
    the epoch's batches, and `peak`, the brightest pixel over the mean of all pixels of all patterns.
    """

    columns: dict[str, list[float]]
    patterns: dict[int, NDArray[np.float32]]
    trained: Trained


def follow(task: Task, profile: Profile, options: Options, *, patterns_after: tuple[int, ...] = ()) -> Course:
    """Train one run of active illumination by `options` and judge it after every epoch; the result is that of `train`."""
    data = TrainingData(task, profile, options)
    run = Run(data, profile, options, 0)
    assert isinstance(run.encoder, ActiveIllumination)
    held_out, labels = encoder_input(task, task.test, profile, options), torch.from_numpy(task.test.labels)
    n = min(TRAINING_OBJECTS, data.n_fit)
    random = torch.Generator().manual_seed(options.seed)
    columns: dict[str, list[float]] = {}
    patterns: dict[int, NDArray[np.float32]] = {}
    while run.epoch < options.epochs:
        trained = run.one_epoch()
        shown = trained.patterns
        of_training = _right(run, data.shown[:n], data.labels[:n], random)
        of_held_out = _right(run, held_out, labels, random)
        figures = {"loss": trained.loss, "training": 100 * float(of_training.mean())}
        figures |= {"held_out": 100 * float(of_held_out.mean())}
        figures |= {"held_out_first_200": 100 * float(of_held_out[:FIRST].mean())}
        figures |= {key: getattr(trained, key) for key in ("clicks", "photons", "illumination")}
        figures |= {"peak": float(shown.max() / shown.mean())}
        for key, value in figures.items():
            columns.setdefault(key, []).append(float(f"{value:.5g}"))
        if run.epoch in patterns_after:
            patterns[run.epoch] = shown
    return Course(columns, patterns, run.finish((run.validation_loss(),)))


def _right(run: Run, shown: Tensor, labels: Tensor, random: torch.Generator) -> Tensor:
    """Whether each object is decided right, from one draw of clicks by the present patterns and head."""
    law = run.law()
    run.head.eval()
    with torch.no_grad():
        p = torch.cat([run.readings.chances(run.encoder(part, run.data.floor), law) for part in shown.split(CHUNK)])
        return (run.head(run.readings.sample(p, random).float()).argmax(dim=1) == labels).double()
