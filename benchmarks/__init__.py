"""Measurements of what should hold, a folder for each question."""

import os

# As in `mapweave.cli`: what is measured is what the commands run.
os.environ.setdefault("OMP_NUM_THREADS", "1")
