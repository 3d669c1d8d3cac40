"""`pans data scene`: a task's objects as a scene that the simulator opens."""

from pathlib import Path

import numpy as np
import pytest
from commands import Pans

from pans_sim.scene.still import load_scene
from pans_trainer.tasks.registry import draw_task


@pytest.mark.parametrize("part", ["test", "train"])
def test_a_drawn_task_becomes_a_scene(part: str, tmp_path: Path, pans: Pans) -> None:
    out = tmp_path / "flow.npz"
    told = pans("data", "scene", "cells", "-o", out, "--objects", "6", "--part", part)
    assert (told["objects"], told["height_px"], told["width_px"], told["part"]) == (6, 100, 100, part)
    scene = load_scene(out)
    task = draw_task("cells", 0, 6, 6)
    wanted = getattr(task, part)
    assert np.array_equal(scene.images, wanted.images)
    assert scene.labels.tolist() == wanted.labels.tolist()
    assert scene.classes == task.classes
