"""Whether anything is lost when processes are killed, frozen and cut off."""
