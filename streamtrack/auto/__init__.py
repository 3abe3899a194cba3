"""Automatic targets: what moves against the background is found, named and followed."""

from streamtrack.auto.targets import AutoTargets

__all__ = ["AutoTargets"]
