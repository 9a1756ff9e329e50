"""From when until when a certificate holds, read without the libraries that sign: robots do not have them."""

import re
from datetime import UTC, datetime

from mapweave.wire.credentials import Credentials

_TIME = rb"(?:\x17\x0d\d{12}Z|\x18\x0f\d{14}Z)"
_VALIDITY = re.compile(rb"\x30[\x1e\x20\x22](" + _TIME + rb")(" + _TIME + rb")")
"""Two times, each a UTCTime or a GeneralizedTime in DER (RFC 5280, 4.1.2.5)."""


def validity(certificate: str) -> tuple[datetime, datetime] | None:
    """The first and the last moment at which a certificate (PEM) holds; None if it cannot be read."""
    # It loads OpenSSL, which a command without a key does not need.
    import ssl

    try:
        found = _VALIDITY.search(ssl.PEM_cert_to_DER_cert(certificate))
    except ValueError:
        return None
    if found is None:
        return None
    begin, end = (_time(one) for one in found.groups())
    return begin, end


def out_of_date(holder: Credentials | None, now: datetime | None = None) -> str:
    """Why the own certificate does not hold now, and what to do; empty if it does, or if there is none.

    Args:
        holder: of the key.
        now: the time; None for that of this machine's clock.
    """
    times = validity(holder.certificate) if holder is not None and holder.certified else None
    if holder is None or times is None:
        return ""
    (begin, end), now = times, now or datetime.now(UTC)
    if now > end:
        return (
            f"the certificate of {holder.name} expired on {_words(end)}: `mapweave keys add {holder.name} "
            f"--role {holder.role.value}` at the server makes a new key file, to copy here"
        )
    if now < begin:
        return (
            f"the certificate of {holder.name} holds from {_words(begin)} on, and by this machine's clock "
            f"it is {_words(now)}: set the clock"
        )
    return ""


def _time(der: bytes) -> datetime:
    digits = der[2:-1].decode()
    if len(digits) == 12:
        # Two digits of the year: from 1950 to 2049.
        digits = ("19" if digits[0] >= "5" else "20") + digits
    return datetime.strptime(digits, "%Y%m%d%H%M%S").replace(tzinfo=UTC)


def _words(moment: datetime) -> str:
    return f"{moment:%Y-%m-%d %H:%M} UTC"
