"""The instrument as a state machine without I/O."""
