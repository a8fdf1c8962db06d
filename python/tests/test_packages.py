"""Packages: inspecting, signing, verifying."""

from __future__ import annotations

import pytest

import distributed_observer as do


@pytest.fixture
def package() -> bytes:
    package = do.load("paper").package(1)
    assert package is not None
    return package


def test_inspect_shows_what_the_command_line_shows(package, host_sim, tmp_path):
    path = tmp_path / "one.weights"
    path.write_bytes(package)
    assert do.inspect(package) == do.inspect(path) == host_sim("weights", "inspect", path)


def test_a_signed_package_verifies_with_its_key_only(package, host_sim, tmp_path):
    pair, other = do.keygen(tmp_path / "operator"), do.keygen(tmp_path / "other")
    signed = do.sign(package, pair["private_key"])
    report = do.verify(signed, pair["public_key"])
    assert report["signature_checked"] and report["key_fingerprint"] == pair["fingerprint"]
    path = tmp_path / "one.weights"
    path.write_bytes(package)
    host_sim("weights", "sign", path, "--key", pair["private_key"])
    assert path.read_bytes() == signed
    expected = host_sim("weights", "verify", path, "--key", other["public_key"])["error"]
    with pytest.raises(do.ObserverError) as raised:
        do.verify(path, other["public_key"])
    assert (str(raised.value), raised.value.code) == (expected["text"], "package-refused")
    with pytest.raises(do.ObserverError, match="already signed with a key other than"):
        do.sign(signed, other["private_key"])
    again = do.sign(signed, other["private_key"], replace_signature=True)
    do.verify(again, other["public_key"])
    assert do.inspect(do.sign(package, pair["private_key"], epoch=7))["epoch"] == 7


def test_an_older_package_is_refused(package):
    report = do.verify(package)
    assert report["version"] == 1 and not report["signed"]
    with pytest.raises(do.ObserverError) as raised:
        do.verify(package, in_use=package)
    assert raised.value.code == "package-refused"


def test_keys_are_not_overwritten(tmp_path):
    do.keygen(tmp_path / "operator")
    with pytest.raises(do.ObserverError, match="already exists"):
        do.keygen(tmp_path / "operator")


def test_an_encrypted_key_needs_its_passphrase(package, tmp_path):
    import shutil
    import subprocess

    if shutil.which("openssl") is None:
        pytest.skip("no openssl")
    key = tmp_path / "encrypted.pem"
    plain = do.keygen(tmp_path / "operator")
    line = ["openssl", "pkcs8", "-topk8", "-in", plain["private_key"], "-out", key, "-passout", "pass:word"]
    subprocess.run(line, check=True)
    key.chmod(0o600)
    with pytest.raises(do.ObserverError) as raised:
        do.sign(package, key)
    assert raised.value.code == "invalid-key"
    do.verify(do.sign(package, key, passphrase="word"), plain["public_key"])
