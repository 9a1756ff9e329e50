"""What to do with a file or a database of another format than this program's, in words."""


def of_format(stored: int, used: int) -> str:
    """That something has another format, and what to do, as the end of a sentence."""
    return f"of format {stored}, this program uses {used}: {what_to_do(stored, used)}"


def what_to_do(stored: int, used: int) -> str:
    """What to do.

    Args:
        stored: format of the file or the database.
        used: that of this program.
    """
    if stored > used:
        return "a newer version of Mapweave has written it: upgrade this one, or use a backup of before"
    return "use the version of Mapweave that has written it"
