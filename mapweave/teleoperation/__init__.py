"""Driving a robot by hand: keyboard, gamepad, and the questions that carry the commands."""
