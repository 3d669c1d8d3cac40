"""A port: device URL to stamped bytes to connection."""
