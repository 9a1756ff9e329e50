"""Where two views of a place were taken from each other: matching, minimal postures, refinement, verdict."""
