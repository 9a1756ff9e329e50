"""How well places are recognised on real recordings: one pass maps, another asks."""
