"""The training loop, its schedule, data, checkpoints and searches."""
