"""Shells around the device: in process, pty, TCP, USB, and faults on the way."""
