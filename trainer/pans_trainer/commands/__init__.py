"""The commands of the trainer: arguments come in, an answer and an exit code go out."""
