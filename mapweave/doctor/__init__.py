"""Examination of a robot. Libraries are imported where they are used: a missing one is a finding."""
