"""Hostile input: every decoder is given what no honest sender sends."""
