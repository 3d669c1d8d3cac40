"""From a trained model to a bundle, and the check that the bundle decides as the model does.

A trained model comes in, a written bundle with the measured differences goes out. Start with `writer.py` (fixed patterns) or
`automaton.py`; `ordering.py` changes the order of a bundle's patterns, `python -m pans_trainer.export.tape_bundle` needs no training.
"""
