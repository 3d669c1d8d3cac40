"""What `pans train` chooses for a user's own images: how they may be varied, the encoder, the size of the training, and warnings.

A task and a profile come in, a `Recipe` with its reasons goes out. Everything is in `recipe.py`.
"""
