"""The first bytes of what robots and people have made: no other kind of file is written over it."""

SQLITE = b"SQLite format 3\0"
"""Of every SQLite file, as stores and journals are (https://sqlite.org/fileformat2.html, 1.3.1)."""
MAP_FILE = b"MAPWEAVE"
"""Of every map file."""
