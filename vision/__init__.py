"""Vision shared by robot and server: SIFT features, and the lens."""
