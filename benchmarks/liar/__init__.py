"""Fleets with one robot that lies: what it does to the map and the answers of the others."""
