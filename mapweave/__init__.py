"""The composition root: command line, settings, processes. Nothing imports it."""

import os

# One core a robot. The filters' matrices are small: on a busy machine, BLAS threads that wait for each other
# made an update of the localization filter forty times slower. numpy reads this when it is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
