"""Tasks: labelled 8-bit images for training, and others held out.

Owns the pinned public sets, the generators of the drawn tasks, a user's own files and folders, and the distortions of training images;
never trains and never shows an image to an instrument.

>>> from pans.trainer.tasks import TASKS, load_task
>>> "barcode" in TASKS
True
>>> load_task("barcode").image_shape
(1, 10)
"""

from typing import TYPE_CHECKING

from pans.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from .generators import GENERATORS
    from .registry import TASKS, Objects, Task, load_task, task_names

__all__ = ["GENERATORS", "TASKS", "Objects", "Task", "load_task", "task_names"]

__getattr__ = lazy_names(
    __name__,
    {
        "GENERATORS": ".generators",
        "TASKS": ".registry",
        "Objects": ".registry",
        "Task": ".registry",
        "load_task": ".registry",
        "task_names": ".registry",
    },
)
