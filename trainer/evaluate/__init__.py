"""Accuracy against photons, information, pictures of a bundle."""
