"""From a trained model to a bundle, with the proof that the bundle decides as the model does.

Owns the ONNX graphs, the folding of the normalisation and the comparison; never trains. `python -m pans.trainer.export.tape_bundle`
makes the bundle of a tape of bars, which needs no training.
"""

from typing import TYPE_CHECKING

from pans.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from .automaton import ExportedAutomaton, export_automaton
    from .writer import Exported, export_trained

__all__ = ["Exported", "ExportedAutomaton", "export_automaton", "export_trained"]

__getattr__ = lazy_names(
    __name__,
    {
        "Exported": ".writer",
        "ExportedAutomaton": ".automaton",
        "export_automaton": ".automaton",
        "export_trained": ".writer",
    },
)
