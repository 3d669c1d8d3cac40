"""The torch trainer (extra `train`): patterns and heads are trained through the physics of an instrument and written as bundles.

A task's images come in (`tasks`), a bundle and its figures go out. Start with `train/gradient/loop.py`, or `train/automaton/train.py` for
automata.
"""
