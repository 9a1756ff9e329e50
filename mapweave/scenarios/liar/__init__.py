"""What becomes of a fleet's maps and answers beside one robot that lies."""
