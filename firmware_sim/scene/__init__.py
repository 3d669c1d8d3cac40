"""From what stands or moves before the detector to photoelectrons and clicks.

Owns scenes and their files, the light that they pass through patterns, the detector's law and the random numbers behind each click.
Everything is a function of a seed and the number of the exposure; never knows messages, sessions or clocks of the host.

>>> from pans.firmware_sim.scene import open_scene
>>> open_scene("cells-in-flow").moves
True
"""

from .detector_kernels import sample_words
from .detector_model import DetectorModel
from .moving import SceneFile
from .scene_file import open_scene
from .still import Scene, load_scene

__all__ = ["DetectorModel", "Scene", "SceneFile", "load_scene", "open_scene", "sample_words"]
