"""Time: the device's clock, latency per stage, who was late, a core that does not sleep."""
