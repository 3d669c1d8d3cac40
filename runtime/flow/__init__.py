"""The core for objects that pass by: onset, best window, release, pulses asked."""
