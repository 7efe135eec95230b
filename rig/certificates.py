"""A bench's own certificate authority, and one certificate for each process of a vehicle.

For benches and tests: a fleet has an authority of its own, which signs the same names (`common.access.common_name`).
Each process gets one folder with all that it needs and nothing else, to be mounted into its container alone:
```
OUT/ca/         certificate.pem, key.pem     the authority; its key signs, and belongs on no vehicle
OUT/planner/    ca.pem, certificate.pem, key.pem
```
"""

from __future__ import annotations

import datetime
import ipaddress
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from common.access import ROLES, ROUTER, common_name
from common.config import ConfigError

NAMES = (ROUTER, *ROLES)
"""Folders that a bench gets beside `ca`."""
HOSTS = ("localhost", "router", "127.0.0.1", "::1")
"""Where a router of ours is usually reached: loopback, and its name in the compose file."""
BACKDATED = datetime.timedelta(minutes=5)
"""Certificates begin to be valid this much before they are made: clocks differ."""
EXPIRY_OF_CA = datetime.timedelta(days=365)
"""An authority outlives the certificates it signs by at least this much."""


@dataclass(frozen=True)
class Made:
    """One certificate that was written."""

    folder: Path
    common_name: str
    expires: datetime.datetime


@dataclass(frozen=True)
class Authority:
    """A key that signs, and its certificate."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


def make(
    out: Path,
    vehicle: str,
    lifetime: datetime.timedelta,
    *,
    hosts: Sequence[str] = (),
    ca: Path | None = None,
    owner: int | None = None,
    force: bool = False,
) -> list[Made]:
    """Write an authority (unless one is given) and a certificate for each process of a vehicle.

    Args:
        out: folder to write into.
        vehicle: name of the vehicle; part of every common name.
        lifetime: how long the certificates are valid from now.
        hosts: names and addresses by which the router is reached, beside `HOSTS`.
        ca: folder of an authority that exists (`OUT/ca` of an earlier call) to sign with instead of a new one.
        owner: user id that the processes' files are given to (their containers' user); None: ours.
        force: replace what stands there.

    Returns:
        What was made, the authority first.

    Raises:
        ConfigError: something stands there already, a name or the authority cannot be used, a file not be written.
    """
    try:
        common_names = {name: common_name(name, vehicle) for name in NAMES}
    except ValueError as e:
        raise ConfigError(str(e)) from None
    standing = [out / name for name in (*NAMES, *(() if ca else ("ca",))) if (out / name).exists()]
    if standing and not force:
        raise ConfigError(
            f"{standing[0]} stands there already: --force replaces it, and whoever uses it needs the new one"
        )
    names = [host_name(h) for h in (*HOSTS, *hosts)]
    now = datetime.datetime.now(datetime.UTC)
    try:
        authority = _new_authority(now, lifetime + EXPIRY_OF_CA) if ca is None else _load(ca)
        if authority.certificate.not_valid_after_utc < now + lifetime:
            raise ConfigError(
                f"--ca {ca}: expires {authority.certificate.not_valid_after_utc:%Y-%m-%d}, before what it is to sign"
            )
        made = []
        if ca is None:
            _write(out / "ca", {"certificate.pem": _pem(authority.certificate)}, authority.key, None)
            made.append(Made(out / "ca", "authority", authority.certificate.not_valid_after_utc))
        for name in NAMES:
            key = ec.generate_private_key(ec.SECP256R1())
            certificate = sign(
                authority, key, common_names[name], now - BACKDATED, now + lifetime,
                hosts=names if name == ROUTER else (),
            )  # fmt: skip
            files = {"ca.pem": _pem(authority.certificate), "certificate.pem": _pem(certificate)}
            _write(out / name, files, key, owner)
            made.append(Made(out / name, common_names[name], certificate.not_valid_after_utc))
        return made
    except OSError as e:
        raise ConfigError(f"{e.filename or out}: {e.strerror}") from None


def sign(
    authority: Authority,
    key: ec.EllipticCurvePrivateKey,
    name: str,
    begins: datetime.datetime,
    expires: datetime.datetime,
    *,
    hosts: Sequence[x509.GeneralName] = (),
) -> x509.Certificate:
    """A certificate for `name`; with `hosts` it may be a server there, without it is a client's alone."""
    usages = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if hosts else [])]
    builder = (
        _builder(name, authority.certificate.subject, key, begins, expires)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key()), critical=False)
    )
    if hosts:
        builder = builder.add_extension(x509.SubjectAlternativeName(hosts), critical=False)
    return builder.sign(authority.key, hashes.SHA256())


def _new_authority(now: datetime.datetime, lifetime: datetime.timedelta) -> Authority:
    key = ec.generate_private_key(ec.SECP256R1())
    name = "Forefield bench authority"
    usage = x509.KeyUsage(
        key_cert_sign=True, crl_sign=True, digital_signature=False, content_commitment=False, key_encipherment=False,
        data_encipherment=False, key_agreement=False, encipher_only=False, decipher_only=False,
    )  # fmt: skip
    builder = (
        _builder(name, _subject(name), key, now - BACKDATED, now + lifetime)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
    )
    return Authority(builder.sign(key, hashes.SHA256()), key)


def _load(folder: Path) -> Authority:
    try:
        certificate = x509.load_pem_x509_certificate((folder / "certificate.pem").read_bytes())
        key = serialization.load_pem_private_key((folder / "key.pem").read_bytes(), password=None)
    except FileNotFoundError as e:
        raise ConfigError(f"--ca {folder}: no {Path(e.filename).name} there; give OUT/ca of an earlier call") from None
    except (ValueError, TypeError) as e:
        raise ConfigError(f"--ca {folder}: {e}") from None
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
        raise ConfigError(f"--ca {folder}: key.pem is not the key of certificate.pem")
    return Authority(certificate, key)


def _builder(
    name: str,
    issuer: x509.Name,
    key: ec.EllipticCurvePrivateKey,
    begins: datetime.datetime,
    expires: datetime.datetime,
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(_subject(name))
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(begins)
        .not_valid_after(expires)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _subject(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def host_name(host: str) -> x509.GeneralName:
    """A name or an address, as certificates write it.

    Raises:
        ConfigError: neither.
    """
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        pass
    try:
        return x509.DNSName(host)
    except ValueError:
        raise ConfigError(f"--host {host!r}: neither an address nor a host name in ASCII") from None


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _write(folder: Path, files: dict[str, bytes], key: ec.EllipticCurvePrivateKey, owner: int | None) -> None:
    """One process' folder; the key is never readable by anyone but its owner, not even for a moment."""
    folder.mkdir(parents=True, mode=0o755, exist_ok=True)
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    for name, content, mode in (*((n, c, 0o644) for n, c in files.items()), ("key.pem", private, 0o600)):
        path = folder / name
        path.unlink(missing_ok=True)
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as f:
            f.write(content)
        if owner is not None:
            os.chown(path, owner, -1)
