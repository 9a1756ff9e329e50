"""Tests, and what they share: pytest finds the tests, they import the rest by its name."""
