"""Tasks: labelled 8-bit images to train on, and others held out.

A name, a file or a folder comes in, a `Task` goes out. Start with `registry.py`; public sets are in `public_sets.py`, drawn tasks in
`generators.py`, changes of training images in `changes.py`.

>>> from pans_trainer.tasks import TASKS, load_task
>>> "barcode" in TASKS
True
>>> load_task("barcode").image_shape
(1, 10)
"""

from .generators import GENERATORS
from .registry import TASKS, Objects, Task, load_task, task_names

__all__ = ["GENERATORS", "TASKS", "Objects", "Task", "load_task", "task_names"]
