"""Files and databases: maps, images, settings, and writes that survive a loss of power."""
