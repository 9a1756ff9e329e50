"""Images whose truth is known: warped, printed, and simulated."""
