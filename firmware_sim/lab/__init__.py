"""The instrument on a computer: the C core with a projector and a counter that other libraries drive.

`apparatus` says what a projector and a counter are and joins them, `alp` and `tagger` are two of them, `core` is the binding of
firmware_sim/reference. `pans instrument` serves it.
"""
