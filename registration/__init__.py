"""Where two views of a place were taken from each other: matching, minimal poses, refinement, verdict."""
