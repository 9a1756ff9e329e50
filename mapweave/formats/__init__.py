"""Maps for the tools of others: g2o, TUM, GraphML, GeoJSON."""
