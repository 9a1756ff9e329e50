"""The hybrid topological-metric map and its geometry: values and pure functions, no input or output."""
