"""The reference instrument in C behind `pans simulate --engine c`: its compiler, its process and the light that it asks for.

The firmware is in firmware_sim/reference and follows the protocol alone; the physics stays the simulator's own. `CEngine` is a running one
behind a port, `SteppedEngine` one in this process whose time is an argument. Nothing is
built before it is asked for, and the same sources once.
"""

from .build import engine_library, engine_program
from .process import CEngine
from .stepped import SteppedEngine

__all__ = ["CEngine", "SteppedEngine", "engine_library", "engine_program"]
