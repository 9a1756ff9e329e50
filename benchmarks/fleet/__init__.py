"""How many robots one map server carries."""
