"""Secrets are known by their keys, wherever these stand."""

from __future__ import annotations

import pytest

from potschemas.redaction import HIDDEN, holds_secret, is_secret, redacted


@pytest.mark.parametrize(
    "key",
    [
        "password",
        "transport/auth/usrpwd/password",
        "zenoh.cfg.transport/auth/usrpwd/password",
        "transport/link/tls/listen_private_key_base64",
        "private_key_pem",
        "client_secret",
    ],
)
def test_keys_of_secrets(key: str) -> None:
    assert is_secret(key)


@pytest.mark.parametrize(
    "key",
    ["transport/link/tls/listen_private_key", "public_key_pem", "usrpwd/user", "max_tokens", "n_tokens"],
)
def test_keys_of_no_secrets(key: str) -> None:
    assert not is_secret(key)


@pytest.mark.parametrize(
    "text",
    [
        'transport/auth:{usrpwd:{user:"u",password:"hush"}}',
        "{'password': 'hush', x: 1}",
        "tls/host:7447#connect_private_key_base64=hush;other=1",
        'zenoh.cfg={"transport/auth/usrpwd/password" = "hush"}',
        "password: hush, then",
        r'password:"hu\"hush"',
    ],
)
def test_secrets_within_texts(text: str) -> None:
    assert holds_secret(text)
    assert "hush" not in redacted(text)
    assert HIDDEN in redacted(text)


def test_trees_are_redacted_and_otherwise_the_same() -> None:
    tree = {
        "zenoh": {
            "cfg": {"transport/auth/usrpwd/password": "hush", "mode": "peer"},
            "listen": ["tcp/[::]:7447"],
        },
        "password": ["hush", "hush"],
        "secret": None,
        "n": 3,
    }
    assert redacted(tree) == {
        "zenoh": {
            "cfg": {"transport/auth/usrpwd/password": HIDDEN, "mode": "peer"},
            "listen": ["tcp/[::]:7447"],
        },
        "password": HIDDEN,
        "secret": None,
        "n": 3,
    }
    assert "hush" in str(tree), "the tree itself is untouched"
    assert not holds_secret("the password was wrong"), "words alone are no secrets"
