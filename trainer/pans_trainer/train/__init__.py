"""Training: `gradient` trains fixed patterns and passive optics, `automaton` patterns that follow the clicks.

Start at gradient/loop.py, or at automaton/train.py.
"""
