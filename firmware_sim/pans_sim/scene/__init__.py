"""From what stands or moves before the detector to photoelectrons and clicks.

Scene files, patterns and exposures come in; photoelectrons and clicks go out, as functions of a seed and the exposure's number. Start with
`scene_file` (what a scene is), `light` (its light through patterns) and `drawing` (the clicks).

>>> from pans_sim.scene import open_scene
>>> open_scene("cells-in-flow").moves
True
"""

from .detector_kernels import sample_words
from .detector_model import DetectorModel
from .moving import SceneFile
from .scene_file import open_scene
from .still import Scene, load_scene

__all__ = ["DetectorModel", "Scene", "SceneFile", "load_scene", "open_scene", "sample_words"]
