"""The alternatives at equal photons."""
