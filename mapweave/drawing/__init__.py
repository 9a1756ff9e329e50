"""Pictures of maps, links and matches."""
