"""Model to bundle, with the proof."""
