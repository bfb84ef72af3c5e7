"""What a walk may count of each ray: visits, tests, and bytes read of nodes and of geometry."""

from typing import Any, NamedTuple

import numpy as np


class Counters(NamedTuple):
    """Counts of one ray or of many, int32 each.

    Attributes:
        nodes: Nodes visited.
        leaves: Leaves visited.
        boxes: Tests of a box, or of a plane of a kd-tree.
        triangles: Tests of a triangle.
        node_bytes: Bytes read of nodes.
        geometry_bytes: Bytes read of triangles, references to them included.
    """

    nodes: Any
    leaves: Any
    boxes: Any
    triangles: Any
    node_bytes: Any
    geometry_bytes: Any

    @property
    def steps(self) -> Any:
        """Nodes and leaves visited."""
        return self.nodes + self.leaves


KINDS = len(Counters._fields)


def counters_of(rows: np.ndarray) -> Counters:
    """The columns of (r, 6) int32."""
    return Counters(*rows.T)
