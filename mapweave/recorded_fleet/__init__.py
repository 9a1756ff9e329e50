"""A recorded fleet for `mapweave server --demo`: its maps in a file, its robots replayed."""
