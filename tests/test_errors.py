"""The exceptions are one family, and each message is one line that helps."""

from __future__ import annotations

import inspect

import pytest

from streamtrack import errors
from streamtrack.errors import (
    OutputError,
    SourceError,
    StreamtrackError,
    TargetError,
    UsageError,
    unknown_name,
)

LEAVES = (UsageError, SourceError, TargetError, OutputError)


def test_the_tree_is_the_one_drawn() -> None:
    assert StreamtrackError.__bases__ == (Exception,)
    for leaf in LEAVES:
        assert leaf.__bases__ == (StreamtrackError,)
    defined = {
        value
        for value in vars(errors).values()
        if inspect.isclass(value) and issubclass(value, Exception)
    }
    assert defined == {StreamtrackError, *LEAVES}
    assert errors.__doc__ is not None
    assert all(error.__name__ in errors.__doc__ for error in defined)


@pytest.mark.parametrize("leaf", LEAVES)
def test_catching_one_does_not_catch_another(leaf: type[StreamtrackError]) -> None:
    others = tuple(other for other in LEAVES if other is not leaf)
    with pytest.raises(leaf):
        try:
            raise leaf("why")
        except others:
            pytest.fail("caught as another error")


@pytest.mark.parametrize(
    ("name", "suggested"),
    [
        ("harriss", "harris"),
        ("Harris", "harris"),
        ("akase", "akaze"),
        ("zzzzzz", None),
        ("", None),
        ("42", None),
    ],
)
def test_unknown_names_get_the_nearest_one(name: str, suggested: str | None) -> None:
    error = unknown_name("detector", name, iter(["harris", "fast", "akaze"]))
    text = str(error)
    assert isinstance(error, UsageError)
    assert f"unknown detector '{name}'" in text
    assert text.endswith("known are harris, fast, akaze")
    assert ("did you mean" in text) == (suggested is not None)
    if suggested:
        assert f"did you mean {suggested}?" in text
    assert "\n" not in text
