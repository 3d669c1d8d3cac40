"""Protocol 1 without I/O, both ends: bytes to messages, sessions, loss tracking."""
