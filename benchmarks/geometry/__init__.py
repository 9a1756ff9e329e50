"""What a wrongly declared geometry costs a map."""
