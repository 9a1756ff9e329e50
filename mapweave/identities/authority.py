"""The fleet's authority: its certificate, and the certificates that it signs. X.509, ECDSA on P-256."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from mapweave.hybridmap.errors import SettingsError
from mapweave.wire.credentials import Role

AUTHORITY_DAYS = 3650
"""For which the authority of a fleet holds. Chosen: all keys have to be made again after it."""
BACKDATED = timedelta(minutes=5)
"""A robot's clock may be behind."""


@dataclass(frozen=True, slots=True)
class Issued:
    """A key and its certificate.

    Attributes:
        certificate: PEM.
        private_key: PEM.
        expires: when it ends.
    """

    certificate: str
    private_key: str
    expires: datetime


class Authority:
    """Signs certificates of identities."""

    def __init__(self, certificate: str, private_key: str) -> None:
        """Take its certificate and key, PEM.

        Raises:
            SettingsError: they are damaged, or do not belong together.
        """
        try:
            self._certificate = x509.load_pem_x509_certificate(certificate.encode())
            key = serialization.load_pem_private_key(private_key.encode(), None)
        except ValueError as error:
            raise SettingsError(f"the authority's key is damaged: {str(error).splitlines()[0]}") from None
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise SettingsError("the authority's key is not one of `mapweave keys init`")
        if self._certificate.public_key() != key.public_key():
            # As after a restore of one of the two: no router would let in who gets a certificate of this key.
            raise SettingsError(
                "authority.pem and authority.key do not belong together: restore both from one backup"
            )
        self._key = key
        self.certificate = certificate

    @classmethod
    def create(cls, fleet: str, now: datetime | None = None) -> tuple[Authority, str]:
        """A new authority, and its private key, PEM."""
        now = now or datetime.now(UTC)
        key = ec.generate_private_key(ec.SECP256R1())
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"Mapweave fleet {fleet}")])
        certificate = (
            _begin(name, name, key, now, now + timedelta(days=AUTHORITY_DAYS))
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_usage(signs=True), critical=True)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
            .sign(key, hashes.SHA256())
        )
        pem = _pem(key)
        return cls(certificate.public_bytes(serialization.Encoding.PEM).decode(), pem), pem

    def issue(
        self, name: str, role: Role, life: timedelta, hosts: Iterable[str] = (), now: datetime | None = None
    ) -> Issued:
        """A key and a certificate of an identity.

        Args:
            name: its common name, by which the router knows it.
            role: a server's certificate is one that clients accept; no other's is.
            life: how long it holds.
            hosts: names and addresses under which a server is reached.
            now: the present.
        """
        now = now or datetime.now(UTC)
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        uses = [ExtendedKeyUsageOID.CLIENT_AUTH]
        names: list[x509.GeneralName] = [x509.DNSName(name)]
        if role is Role.SERVER:
            uses.append(ExtendedKeyUsageOID.SERVER_AUTH)
            names = [_host(host) for host in hosts]
        expires = min(now + life, self._certificate.not_valid_after_utc)
        certificate = (
            _begin(subject, self._certificate.subject, key, now, expires)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(signs=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
            .add_extension(x509.SubjectAlternativeName(names), critical=False)
            # HTTPS clients that check strictly want it, as Python does from 3.13 on.
            .add_extension(
                x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key()), critical=False
            )
            .sign(self._key, hashes.SHA256())
        )
        pem = certificate.public_bytes(serialization.Encoding.PEM).decode()
        return Issued(pem, _pem(key), expires)


def _begin(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, now: datetime, end: datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - BACKDATED)
        .not_valid_after(end)
    )


def _usage(signs: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs, content_commitment=False, key_encipherment=False,
        data_encipherment=False, key_agreement=False, key_cert_sign=signs, crl_sign=signs,
        encipher_only=False, decipher_only=False,
    )  # fmt: skip


def _pem(key: ec.EllipticCurvePrivateKey) -> str:
    form = serialization.PrivateFormat.PKCS8
    return key.private_bytes(serialization.Encoding.PEM, form, serialization.NoEncryption()).decode()


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)
