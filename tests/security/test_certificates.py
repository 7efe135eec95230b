"""`forefield certs`: what it makes, what it refuses, and who can read the keys."""

from __future__ import annotations

import datetime
import stat
from pathlib import Path

import pytest
from cryptography import x509
from typer.testing import CliRunner

from common import access
from rig.application import app
from rig.certificates import NAMES


def certs(*arguments: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["certs", *arguments])
    return done.exit_code, done.output


@pytest.fixture
def made(tmp_path: Path) -> Path:
    code, said = certs(str(tmp_path / "c"), "--vehicle", "van7", "--days", "3")
    assert code == 0, said
    assert all(name in said for name in NAMES) and "UTC" in said
    return tmp_path / "c"


def test_every_process_gets_a_certificate_with_its_own_name_and_the_asked_lifetime(made: Path) -> None:
    authority = x509.load_pem_x509_certificate((made / "ca" / "certificate.pem").read_bytes())
    for name in NAMES:
        certificate = x509.load_pem_x509_certificate((made / name / "certificate.pem").read_bytes())
        certificate.verify_directly_issued_by(authority)
        (common,) = certificate.subject.get_attributes_for_oid(x509.NameOID.COMMON_NAME)
        assert common.value == access.common_name(name, "van7")
        left = certificate.not_valid_after_utc - datetime.datetime.now(datetime.UTC)
        assert datetime.timedelta(days=2.9) < left <= datetime.timedelta(days=3)
        assert authority.not_valid_after_utc >= certificate.not_valid_after_utc
        (made / name / "ca.pem").read_bytes()


def test_keys_are_for_their_owner_alone_and_all_different(made: Path) -> None:
    keys = [made / name / "key.pem" for name in (*NAMES, "ca")]
    assert all(stat.S_IMODE(k.stat().st_mode) == 0o600 for k in keys)
    assert len({k.read_bytes() for k in keys}) == len(keys)


def test_nothing_is_replaced_unless_asked_and_then_nothing_else_in_the_folder(made: Path) -> None:
    before = {p: p.read_bytes() for p in made.rglob("*.pem")}
    (made / "viz" / "mine.txt").write_text("keep me")
    code, said = certs(str(made), "--vehicle", "van7")
    assert code == 2 and "--force" in said
    assert {p: p.read_bytes() for p in made.rglob("*.pem")} == before
    assert certs(str(made), "--vehicle", "van7", "--force")[0] == 0
    assert all(p.read_bytes() != content for p, content in before.items())
    assert (made / "viz" / "mine.txt").read_text() == "keep me"
    assert stat.S_IMODE((made / "planner" / "key.pem").stat().st_mode) == 0o600


def test_a_second_vehicle_is_signed_by_the_same_authority(made: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    assert certs(str(other), "--vehicle", "van8", "--ca", str(made / "ca"))[0] == 0
    assert not (other / "ca").exists()
    assert (other / "planner" / "ca.pem").read_bytes() == (made / "planner" / "ca.pem").read_bytes()
    certificate = x509.load_pem_x509_certificate((other / "planner" / "certificate.pem").read_bytes())
    certificate.verify_directly_issued_by(
        x509.load_pem_x509_certificate((made / "ca" / "certificate.pem").read_bytes())
    )


def test_hosts_stand_in_the_routers_certificate_and_only_it_may_be_a_server(tmp_path: Path) -> None:
    assert certs(str(tmp_path), "--host", "10.1.2.3", "--host", "van7.local")[0] == 0
    router = x509.load_pem_x509_certificate((tmp_path / "router" / "certificate.pem").read_bytes())
    names = router.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert {"localhost", "router", "van7.local"} <= set(names.get_values_for_type(x509.DNSName))
    assert "10.1.2.3" in {str(a) for a in names.get_values_for_type(x509.IPAddress)}
    for name in NAMES:
        certificate = x509.load_pem_x509_certificate((tmp_path / name / "certificate.pem").read_bytes())
        usage = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        assert (x509.ExtendedKeyUsageOID.SERVER_AUTH in usage) == (name == "router")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--vehicle", "a/b"), "letters, digits"),
        (("--ca", "/nowhere"), "OUT/ca of an earlier call"),
        (("--host", "grüße"), "--host"),
    ],
)
def test_what_cannot_be_used_is_one_line_and_code_2(tmp_path: Path, arguments: tuple[str, ...], words: str) -> None:
    code, said = certs(str(tmp_path / "c"), *arguments)
    assert code == 2 and words in said and "Traceback" not in said
    assert not (tmp_path / "c").exists()


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    code, said = certs(str(tmp_path / "file" / "c"))
    assert code == 2 and "file" in said
