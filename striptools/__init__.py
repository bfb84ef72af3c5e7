"""striptools: triangle meshes made ready for ray tracing.

The public names load on first use, so that `import striptools` stays fast and brings neither JAX nor Numba.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from striptools.mesh.clean import CleanOptions
    from striptools.mesh.io import load_mesh, save_mesh
    from striptools.mesh.mesh import Mesh
    from striptools.options import Options, Report
    from striptools.partition.sah import PartitionOptions
    from striptools.pipeline import convert, convert_with_report, open
    from striptools.reducem.scene import Scene
    from striptools.strips.ordering import OrderingOptions

__version__ = "0.1.0"

_HOME = {
    "CleanOptions": "striptools.mesh.clean",
    "Mesh": "striptools.mesh.mesh",
    "Options": "striptools.options",
    "OrderingOptions": "striptools.strips.ordering",
    "PartitionOptions": "striptools.partition.sah",
    "Report": "striptools.options",
    "Scene": "striptools.reducem.scene",
    "convert": "striptools.pipeline",
    "convert_with_report": "striptools.pipeline",
    "load_mesh": "striptools.mesh.io",
    "open": "striptools.pipeline",
    "save_mesh": "striptools.mesh.io",
}
_SUBPACKAGES = ("measure", "trace")

__all__ = [
    "CleanOptions",
    "Mesh",
    "Options",
    "OrderingOptions",
    "PartitionOptions",
    "Report",
    "Scene",
    "convert",
    "convert_with_report",
    "load_mesh",
    "open",
    "save_mesh",
]


def __getattr__(name: str) -> object:
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    if name in _SUBPACKAGES:
        return import_module(f"striptools.{name}")
    raise AttributeError(f"module 'striptools' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME, *_SUBPACKAGES])
