"""The public surface is what ``__all__`` says, and importing it is cheap."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import numpy as np
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
        ("streamtrack.mosaic.pictures.job", ("av", "rerun", "typer", "pyarrow", "rich", "scipy")),
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


@pytest.mark.parametrize(
    ("arguments", "banned"),
    [
        (("--help",), ("numpy", "cv2", "pydantic", "rich", "streamtrack.settings")),
        (("mosaic", "--help"), ("numpy", "cv2", "streamtrack.cli.track", "streamtrack.cli.bench")),
        (
            ("mosaic", "a.png", "b.png", "-o", "m.png"),
            (
                *("av", "rerun", "pyarrow", "rich", "scipy", "tomllib"),
                *("streamtrack.cli.track", "streamtrack.cli.bench", "streamtrack.cli.devices"),
                *("streamtrack.mosaic.stream", "streamtrack.mosaic.adjustment"),
                *("streamtrack.mosaic.pictures.rotation", "streamtrack.pipeline"),
            ),
        ),
    ],
)
def test_a_command_loads_nothing_that_it_does_not_use(
    arguments: tuple[str, ...], banned: tuple[str, ...], tmp_path: Path
) -> None:
    picture = np.random.default_rng(1).integers(0, 256, (120, 160), np.uint8)
    picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), 2.0), np.uint8)
    for name, part in (("a.png", picture[:, :120]), ("b.png", picture[:, 30:])):
        cv2.imwrite(str(tmp_path / name), cv2.normalize(part, None, 0, 255, cv2.NORM_MINMAX))
    code = f"""
import sys
from streamtrack.__main__ import main
sys.argv[1:] = {arguments!r}
try:
    main()
finally:
    print([m for m in {banned!r} if m in sys.modules])
"""
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=True
    )
    assert ended.stdout.splitlines()[-1] == "[]"


def test_all_that_is_imported_is_installed_with_the_package() -> None:
    # Distributions are not always named as what they hold.
    names = {
        "cv2": "opencv-contrib-python-headless",
        "rerun": "rerun-sdk",
        "rerun_bindings": "rerun-sdk",
    }
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
    declared = {re.split(r"[<>=!~;\[ ]", line)[0] for line in project["dependencies"]}
    imported: set[str] = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
                imported.add(node.module.split(".")[0])
    outside = imported - sys.stdlib_module_names - {"streamtrack"}
    assert {names.get(module, module) for module in outside} <= declared
