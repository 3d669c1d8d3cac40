"""Training of automata: patterns that follow from the clicks before them, by exact sums over all walks.

Owns growing, merging, tuning and the one-bit patterns of an automaton, its budget of light and its calibrated posteriors; never sees the
held-out objects and never writes a bundle (the package export).
"""

from typing import TYPE_CHECKING

from pans.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from .options import AutomatonOptions, check_automaton_options
    from .train import TrainedAutomaton, train_automaton
    from .tune import Progress

__all__ = ["AutomatonOptions", "Progress", "TrainedAutomaton", "check_automaton_options", "train_automaton"]

__getattr__ = lazy_names(
    __name__,
    {
        "AutomatonOptions": ".options",
        "check_automaton_options": ".options",
        "Progress": ".figures",
        "TrainedAutomaton": ".train",
        "train_automaton": ".train",
    },
)
