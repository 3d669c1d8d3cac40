"""Training of automata, whose patterns follow from the clicks before them, by exact sums over all walks.

A task, a profile and `AutomatonOptions` come in, a `TrainedAutomaton` goes out. Start with `train.py` (the stages), then `machine.py` (the
automaton and its gradient).
"""

from .train import TrainedAutomaton, train_automaton
from .tune import Progress

__all__ = ["Progress", "TrainedAutomaton", "train_automaton"]
