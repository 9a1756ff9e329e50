"""The composition root: command line, settings, processes. Nothing imports it."""
