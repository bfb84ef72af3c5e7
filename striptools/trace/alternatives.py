"""The layouts of scenes whose hierarchy is not the default one; each is imported where it is needed."""

from typing import TYPE_CHECKING

from striptools.hierarchies.kdtree import KdTree
from striptools.hierarchies.loose_octree import LooseBvh
from striptools.hierarchies.slbvh import Slbvh
from striptools.hierarchies.stored import StoredHierarchy
from striptools.trace.single import SingleLayout

if TYPE_CHECKING:
    from striptools.reducem.scene import Scene


def lay_out_alternative(scene: "Scene", hierarchy: StoredHierarchy, threads: int) -> SingleLayout:
    """Lay a scene out for the walk of its own hierarchy."""
    match hierarchy:
        case Slbvh():
            from striptools.trace.slbvh import lay_out_slbvh

            return lay_out_slbvh(scene, hierarchy, threads)
        case KdTree():
            from striptools.trace.kdtree import lay_out_kdtree

            return lay_out_kdtree(scene, hierarchy, threads)
        case LooseBvh():
            from striptools.trace.binary import lay_out_loose

            return lay_out_loose(scene, hierarchy, threads)
        case _:
            from striptools.trace.presorted import lay_out_presorted

            return lay_out_presorted(scene, hierarchy, threads)
