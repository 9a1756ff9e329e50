"""One module a command: its arguments, and what it runs. Heavy imports happen when a command runs."""
