"""Labelled images: public sets, generators, a user's own, distortions."""
