from __future__ import annotations

import pytest

from app.governance.semver import Version, meets, parse


@pytest.mark.parametrize(
    ("pin", "met", "unmet"),
    [
        ("1.2.3", ["1.2.3"], ["1.2.4", "1.2.2", "2.2.3"]),
        ("~1.2.3", ["1.2.3", "1.2.10"], ["1.2.2", "1.3.0", "2.2.3"]),
        ("^1.2.3", ["1.2.3", "1.10.0"], ["1.2.2", "2.0.0", "0.9.9"]),
        ("^0.2.1", ["0.2.1", "0.2.9"], ["0.3.0", "0.2.0", "1.2.1"]),
        ("~0.2.1", ["0.2.1", "0.2.9"], ["0.3.0", "0.2.0"]),
        ("^0.0.3", ["0.0.3"], ["0.0.4", "0.0.2"]),
    ],
)
def test_a_version_meets_what_is_asked_for_or_does_not(pin, met, unmet):
    assert all(meets(version, pin) for version in met)
    assert not any(meets(version, pin) for version in unmet)


def test_versions_compare_as_numbers():
    assert parse("1.10.0") > parse("1.9.9")
    assert parse("^2.0.1") == Version(2, 0, 1)
    assert str(Version(1, 2, 3)) == "1.2.3"


@pytest.mark.parametrize("text", ["1.2", "v1.2.3", "1.2.3-rc1", "01.2.3", ">=1.2.3", "", "1.2.3\n", "1.2.9999999999"])
def test_what_is_no_version_is_refused(text):
    with pytest.raises(ValueError, match=r"valid: 1\.2\.3"):
        parse(text)
