"""Commands for weeks and for many files: systemd services, folders of runs, batches; options from a file and tables for other tools.

Each module is one command or one file format and stands alone.
"""
