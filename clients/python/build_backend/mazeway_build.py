"""Builds the package: with the native client where a Rust toolchain is at hand, else pure Python.

A PEP 517 backend that delegates: to maturin, which compiles `native/` into `mazeway._native`, where the
repository around this directory and a cargo that is new enough are there; to hatchling otherwise, or where
the environment says MAZEWAY_PURE=1. MATURIN_PEP517_ARGS goes to maturin, as it documents it. A source
distribution is pure: the native client needs the repository's other crates.
"""

from __future__ import annotations

import importlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

_PACKAGE = Path(__file__).resolve().parents[1]
_WORKSPACE = _PACKAGE.parents[1] / "Cargo.toml"
_REQUIRES = {"maturin": ["maturin>=1.9.4,<2"], "hatchling.build": ["hatchling>=1.24"]}


def _version(text: str) -> tuple[int, ...]:
    found = re.search(r"\d+(\.\d+)+", text)
    return tuple(int(part) for part in found[0].split(".")) if found else ()


def _why_pure() -> str:
    """Why the native client is left out; empty where it is built."""
    if os.environ.get("MAZEWAY_PURE", "") not in ("", "0"):
        return "MAZEWAY_PURE is set"
    if not (_PACKAGE / "Cargo.toml").is_file() or not _WORKSPACE.is_file():
        return "this is no checkout of the repository"
    cargo = shutil.which("cargo")
    if cargo is None:
        return "there is no cargo"
    said = subprocess.run([cargo, "--version"], capture_output=True, text=True, check=False).stdout
    wanted = re.search(r'^rust-version = "([\d.]+)"', _WORKSPACE.read_text(), re.MULTILINE)
    if wanted and _version(said) < _version(wanted[1]):
        return f"cargo {wanted[1]} or later is needed, got {said.strip() or 'none'}"
    return ""


def _backend() -> str:
    why = _why_pure()
    if why:
        print(f"mazeway: building the pure-Python client alone: {why}", file=sys.stderr)
    return "hatchling.build" if why else "maturin"


def _call(hook: str, *arguments: Any) -> Any:
    return getattr(importlib.import_module(_backend()), hook)(*arguments)


def get_requires_for_build_wheel(config_settings: Any = None) -> list[str]:
    """PEP 517."""
    del config_settings
    return _REQUIRES[_backend()]


def get_requires_for_build_editable(config_settings: Any = None) -> list[str]:
    """PEP 660."""
    del config_settings
    return _REQUIRES[_backend()]


def get_requires_for_build_sdist(config_settings: Any = None) -> list[str]:
    """PEP 517."""
    del config_settings
    return _REQUIRES["hatchling.build"]


def prepare_metadata_for_build_wheel(directory: str, config_settings: Any = None) -> str:
    """PEP 517."""
    if _backend() == "maturin":
        return _call("prepare_metadata_for_build_wheel", directory, config_settings)
    return _metadata_of_wheel("build_wheel", directory)


def prepare_metadata_for_build_editable(directory: str, config_settings: Any = None) -> str:
    """PEP 660."""
    if _backend() == "maturin":
        return _call("prepare_metadata_for_build_editable", directory, config_settings)
    return _metadata_of_wheel("build_editable", directory)


def _metadata_of_wheel(hook: str, directory: str) -> str:
    """Hatchling leaves this hook out: a pure wheel is built in no time."""
    import tempfile  # rarely needed
    import zipfile

    with tempfile.TemporaryDirectory() as place:
        name = _call(hook, place)
        with zipfile.ZipFile(Path(place) / name) as wheel:
            names = [n for n in wheel.namelist() if n.split("/")[0].endswith(".dist-info")]
            wheel.extractall(directory, names)
        return names[0].split("/")[0]


def build_wheel(directory: str, config_settings: Any = None, metadata_directory: str | None = None) -> str:
    """PEP 517."""
    return _call("build_wheel", directory, config_settings, metadata_directory)


def build_editable(directory: str, config_settings: Any = None, metadata_directory: str | None = None) -> str:
    """PEP 660."""
    return _call("build_editable", directory, config_settings, metadata_directory)


def build_sdist(directory: str, config_settings: Any = None) -> str:
    """PEP 517."""
    return importlib.import_module("hatchling.build").build_sdist(directory, config_settings)
