"""The public surface is what ``__all__`` says, and importing it is cheap."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import streamtrack

PACKAGE = Path(streamtrack.__file__).parent


def test_all_names_exist_and_are_sorted() -> None:
    assert streamtrack.__all__ == sorted(streamtrack.__all__)
    for name in streamtrack.__all__:
        assert getattr(streamtrack, name).__name__ == name


def test_all_names_are_known_to_type_checkers() -> None:
    tree = ast.parse((PACKAGE / "__init__.py").read_text())
    imported = {
        alias.asname or alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("streamtrack")
        for alias in node.names
    }
    assert imported == set(streamtrack.__all__)


def test_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = streamtrack.nothing


@pytest.mark.parametrize(
    ("module", "banned"),
    [
        ("streamtrack", ("cv2", "av", "rerun", "numpy", "typer")),
        ("streamtrack.cli", ("cv2", "av", "rerun", "numpy", "pydantic", "rich")),
        ("streamtrack.sources", ("cv2", "av", "rerun")),
        ("streamtrack.pipeline", ("av", "rerun", "typer")),
        ("streamtrack.job", ("av", "rerun", "typer", "pyarrow")),
    ],
)
def test_heavy_modules_are_imported_where_they_are_used(
    module: str, banned: tuple[str, ...]
) -> None:
    code = f"import sys, {module}; print([m for m in {banned!r} if m in sys.modules])"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"
