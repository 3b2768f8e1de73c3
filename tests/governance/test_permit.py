from __future__ import annotations

import json
from dataclasses import fields, replace

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.governance.model import Authorization, CoveredRecovery, Mode, Strategy
from app.governance.permit import Grant, PermitError, SignedAuthorization, canonical, mint, verify

KEY = Ed25519PrivateKey.generate()
PERMIT = Authorization(
    id="auth-1",
    invocation="inv-1",
    cell="workcell-1",
    capability="grasp_object",
    version="1.0.0",
    params={"object_id": "mug_1", "force_n": 40.0, "deep": {"list": [1, None, True]}},
    mode=Mode.NORMAL,
    profile="human-shared",
    policy_digest="sha256:policy",
    issued_at_s=1000.25,
    expires_at_s=1030.25,
    recoveries=(
        CoveredRecovery(
            strategy=Strategy.RECOVERY_CAPABILITY,
            capability="release_and_retract",
            params={"speed_mps": 0.15},
            mode=Mode.CAREFUL,
        ),
    ),
    approvals=("operator", "operator_2"),
    confirm_before=("release",),
)


def check(signed: SignedAuthorization, **changes: object) -> Grant:
    asked = {
        "key": KEY.public_key(),
        "cell": "workcell-1",
        "policy_digest": "sha256:policy",
        "now_s": 1010.0,
        "used": frozenset(),
    }
    return verify(signed, **(asked | changes))  # type: ignore[arg-type]


def code(signed: SignedAuthorization, **changes: object) -> str:
    with pytest.raises(PermitError) as caught:
        check(signed, **changes)
    return caught.value.code


def signed_text(text: str) -> SignedAuthorization:
    body = text.encode()
    return SignedAuthorization(body, KEY.sign(body))


def test_what_is_minted_verifies_to_the_same_authorization() -> None:
    assert check(mint(PERMIT, KEY)).authorization == PERMIT


def test_every_field_of_the_authorization_is_signed() -> None:
    body = json.loads(mint(PERMIT, KEY).body)
    assert set(body) == {field.name for field in fields(Authorization)}


def test_one_changed_bit_of_the_body_is_a_bad_signature() -> None:
    signed = mint(PERMIT, KEY)
    changed = signed.body.replace(b"40.0", b"60.0")
    assert changed != signed.body
    assert code(SignedAuthorization(changed, signed.signature)) == "bad_signature"


@pytest.mark.parametrize("signature", [b"", b"\0" * 64, b"short"])
def test_a_signature_that_is_none_is_bad(signature: bytes) -> None:
    assert code(SignedAuthorization(mint(PERMIT, KEY).body, signature)) == "bad_signature"


def test_another_kernel_s_key_is_a_bad_signature() -> None:
    assert code(mint(PERMIT, Ed25519PrivateKey.generate())) == "bad_signature"


def test_nothing_of_an_unsigned_body_is_parsed() -> None:
    assert code(SignedAuthorization(b"{" * 100_000, b"\0" * 64)) == "bad_signature"


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"cell": "workcell-2"}, "wrong_cell"),
        ({"policy_digest": "sha256:other"}, "wrong_policy"),
        ({"now_s": 1030.25}, "expired"),
        ({"now_s": 997.0}, "not_yet_valid"),
        ({"now_s": float("nan")}, "not_yet_valid"),
        ({"now_s": float("inf")}, "expired"),
        ({"used": frozenset({"auth-1"})}, "used"),
        ({"forgotten_s": 1030.25}, "clock_put_back"),
        ({"forgotten_s": float("nan")}, "clock_put_back"),
        ({"begun_s": 1000.26}, "used"),
        ({"begun_s": 1030.0}, "used"),
    ],
)
def test_a_good_signature_is_not_enough(changes: dict[str, object], expected: str) -> None:
    assert code(mint(PERMIT, KEY), **changes) == expected


def test_a_permit_is_good_until_just_before_its_expiry_and_despite_a_small_clock_difference() -> None:
    assert check(mint(PERMIT, KEY), now_s=1030.24)
    assert check(mint(PERMIT, KEY), now_s=998.5)


def test_a_permit_that_expires_after_all_that_were_forgotten_was_not_among_them() -> None:
    assert check(mint(PERMIT, KEY), forgotten_s=1030.24)


@pytest.mark.parametrize("begun_s", [900.0, 1000.0, 1030.25, 9000.0, float("nan")])
def test_a_permit_that_was_not_good_when_the_cell_began_to_keep_them_was_not_bound_before(begun_s: float) -> None:
    assert check(mint(PERMIT, KEY), begun_s=begun_s), "a clock that ran ahead by then and was put back bars nothing"


def test_a_refusal_after_the_signature_names_the_invocation() -> None:
    with pytest.raises(PermitError) as caught:
        check(mint(PERMIT, KEY), cell="other")
    assert caught.value.invocation == "inv-1"


def _without(name: str) -> str:
    body = json.loads(mint(PERMIT, KEY).body)
    del body[name]
    return json.dumps(body)


def _with(**changes: object) -> str:
    return json.dumps(json.loads(mint(PERMIT, KEY).body) | changes)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "null",
        "{" * 5000,
        "[" * 100_000,
        _without("expires_at_s"),
        _with(surprise=1),
        _with(expires_at_s="soon"),
        _with(expires_at_s=True),
        _with(issued_at_s=None),
        _with(id=""),
        _with(id=7),
        _with(mode="reckless"),
        _with(params=[]),
        _with(params={"force_n": float("nan")}),
        _with(recoveries={}),
        _with(recoveries=[{"strategy": "RETRY"}]),
        _with(recoveries=[1]),
        _with(approvals="operator"),
        _with().replace("1030.25", "1e999"),
        _with(params={"force_n": 1}).replace('"force_n": 1', '"force_n": 1e999'),
        _with(params={"force_n": [1]}).replace("[1]", "[-1e999]"),
    ],
)
def test_a_signed_body_that_is_no_authorization_is_malformed(text: str) -> None:
    assert code(signed_text(text)) == "malformed"


def test_a_grant_cannot_be_made_without_verifying() -> None:
    with pytest.raises(TypeError, match="made by `verify` alone"):
        Grant(authorization=PERMIT, _proof=object())


def test_a_grant_cannot_be_made_over_for_another_authorization() -> None:
    grant = check(mint(PERMIT, KEY))
    with pytest.raises((TypeError, ValueError)):
        replace(grant, authorization=replace(PERMIT, capability="operate_tool"), _proof=None)


def test_a_grant_covers_its_own_capability_and_its_recoveries_with_exactly_their_parameters() -> None:
    grant = check(mint(PERMIT, KEY))
    assert grant.covers("grasp_object", PERMIT.params)
    assert grant.covers("grasp_object", {**PERMIT.params, "force_n": 40})
    assert grant.covers("release_and_retract", {"speed_mps": 0.15})
    assert not grant.covers("grasp_object", {**PERMIT.params, "force_n": 41.0})
    assert not grant.covers("grasp_object", {"speed_mps": 0.15})
    assert not grant.covers("release_and_retract", {})
    assert not grant.covers("operate_tool", PERMIT.params)
    assert not grant.covers("release_and_retract", {"speed_mps": float("nan")})
    assert not grant.covers("release_and_retract", {"speed_mps": object()})  # type: ignore[dict-item]


def test_true_is_not_one() -> None:
    grant = check(mint(replace(PERMIT, params={"flag": True}), KEY))
    assert not grant.covers("grasp_object", {"flag": 1})


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), object(), "\ud800", b"bytes"])
def test_what_is_no_json_cannot_be_minted(bad: object) -> None:
    with pytest.raises(ValueError, match="not"):
        mint(replace(PERMIT, params={"bad": bad}), KEY)  # type: ignore[dict-item]


def test_canonical_json_does_not_depend_on_the_order_of_keys() -> None:
    assert (
        canonical({"b": 1, "a": (True, None)}) == canonical({"a": [True, None], "b": 1}) == b'{"a":[true,null],"b":1}'
    )
