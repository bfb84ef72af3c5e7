"""What a scene may have in the place of the default hierarchy."""

from striptools.hierarchies.kdtree import KdTree
from striptools.hierarchies.loose_octree import LooseBvh
from striptools.hierarchies.presorted import Presorted
from striptools.hierarchies.slbvh import Slbvh

StoredHierarchy = Slbvh | KdTree | LooseBvh | Presorted
