"""Who belongs to a fleet: the authority, the identities that it has given keys, and key files."""
