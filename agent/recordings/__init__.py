"""Recordings of other programs and of our own: read as one form, written as MCAP with standard messages."""
