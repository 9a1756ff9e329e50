"""From when until when a certificate holds, by its bytes alone."""

from datetime import UTC, datetime, timedelta

import pytest

from mapweave.identities.authority import Authority
from mapweave.identities.validity import out_of_date, validity
from mapweave.wire.credentials import Credentials, Role

NOW = datetime(2026, 11, 27, 5, 0, 7, tzinfo=UTC)


@pytest.mark.parametrize("days", [1, 365, 3600])
@pytest.mark.parametrize("now", [NOW, datetime(2046, 6, 1, tzinfo=UTC), datetime(2050, 2, 3, 4, tzinfo=UTC)])
def test_a_certificate_says_when_it_holds(now: datetime, days: int):
    authority, _ = Authority.create("a-fleet-with-a-name", now)
    issued = authority.issue("r0", Role.ROBOT, timedelta(days=days), now=now)
    assert validity(issued.certificate) == (now - timedelta(minutes=5), issued.expires)


def test_what_is_no_certificate_says_nothing():
    assert validity("nonsense") is None
    head, foot = "-----BEGIN CERTIFICATE-----", "-----END CERTIFICATE-----"
    assert validity(f"{head}\nAAAA\n{foot}\n") is None
    assert validity(f"{head}\n!\n{foot}\n") is None


def test_only_what_does_not_hold_is_reported():
    authority, _ = Authority.create("demo", NOW)
    issued = authority.issue("anna", Role.OPERATOR, timedelta(days=1), now=NOW)
    anna = Credentials("anna", Role.OPERATOR, authority.certificate, issued.certificate, issued.private_key)
    assert out_of_date(anna, NOW) == out_of_date(None) == ""
    assert out_of_date(Credentials("anna", Role.OPERATOR, password="secret")) == ""
    late = out_of_date(anna, NOW + timedelta(days=2))
    assert late.startswith("the certificate of anna expired on 2026-11-28 05:00 UTC: ")
    assert "`mapweave keys add anna --role operator`" in late
    early = out_of_date(anna, NOW - timedelta(days=400))
    assert "holds from 2026-11-27 04:55 UTC on" in early and "set the clock" in early
