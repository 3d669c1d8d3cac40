"""The shell around the core while a device runs."""
