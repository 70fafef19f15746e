"""Data sets as TOML: where their files lie, how they go together, whether they are registered, whose they
are.

A manifest is data, never code: it names files below a root that the user gives, and what it names must
lie inside that root. It is found by name in the user's folder ($FUSION_DATASETS, else
~/.config/fusion/datasets), in the installed package, or in the checkout's `datasets/`, in this order.
`Manifest.plan(root)` says what of it lies below a root, as a `Layout`.
"""

from __future__ import annotations

from fusion.manifest.find import MAX_MANIFEST_BYTES, TEMPLATES, Listed, list_manifests, load_manifest
from fusion.manifest.layout import CalibrationFiles, Layout, Partners, RecordingFiles, RoleFiles
from fusion.manifest.model import ROLES, Manifest

FORMAT = "fusion-dataset/1"

__all__ = [
    "FORMAT",
    "MAX_MANIFEST_BYTES",
    "ROLES",
    "TEMPLATES",
    "CalibrationFiles",
    "Layout",
    "Listed",
    "Manifest",
    "Partners",
    "RecordingFiles",
    "RoleFiles",
    "list_manifests",
    "load_manifest",
]
