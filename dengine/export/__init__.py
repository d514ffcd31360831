"""The engine's whole decision as one checked file for the cell controller: TorchScript, or ONNX."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .._lazy import lazy_names

if TYPE_CHECKING:
    from .file import read_metadata, sum_file
    from .onnx import export_onnx, load_onnx
    from .signing import make_key
    from .sources import export_sources
    from .torchscript import ExportedDecision, ExportedModel, export_torchscript, load_exported

_WHERE = {
    "file": (
        "read_metadata",
        "sum_file",
    ),
    "onnx": (
        "export_onnx",
        "load_onnx",
    ),
    "signing": ("make_key",),
    "sources": ("export_sources",),
    "torchscript": (
        "ExportedDecision",
        "ExportedModel",
        "export_torchscript",
        "load_exported",
    ),
}

__all__ = [
    "ExportedDecision",
    "ExportedModel",
    "export_onnx",
    "export_sources",
    "export_torchscript",
    "load_exported",
    "load_onnx",
    "make_key",
    "read_metadata",
    "sum_file",
]

__getattr__, __dir__ = lazy_names(__name__, _WHERE)
