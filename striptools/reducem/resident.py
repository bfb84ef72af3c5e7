"""How many bytes a tracer keeps of a scene, counted without tracing; tests compare with the tracer's count.

Expanded: 320 bytes a run, 224 a node, and 8 a face of the source. Compressed: nodes, block data and remap as
they are in a file that stores its boxes, else in size classes, and beside them what is worked out of headers
and runs, 64 bytes a block and 32 a node.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from striptools.hierarchies.packed import PackedNodes
    from striptools.reducem.blocks import Blocks
    from striptools.reducem.scene import Scene

Residency = Literal["expanded", "compressed"]

RUN_BYTES, NODE_BYTES, FACE_BYTES = 320, 224, 8
NODE_RECORD_BYTES, SLOTS_BYTES, WORD_BYTES, BLOCK_WORDS = 64, 32, 4, 16
BLOCK_BYTES = WORD_BYTES * BLOCK_WORDS
EXPANDED_STEPS, COMPRESSED_STEPS = 4, 16
"""Size classes to each doubling."""


def size_class(count: int, steps: int = EXPANDED_STEPS) -> int:
    """The least of 1024, 1218, 1449, 1723, 2048, ... (`steps` to each doubling) that is at least `count`.

    A program is compiled for the sizes of its arrays: scenes of the same class share it.
    """
    step = 10 * steps
    while (size := math.ceil(2 ** (step / steps))) < count:
        step += 1
    return size


def resident_bytes(scene: "Scene", resident: Residency) -> int | None:
    """What a tracer keeps of a scene through its stored hierarchy; None where that is not counted here.

    A GPU keeps the nodes of a compressed scene once more, as bytes (`Tracer.resident_bytes`).

    Args:
        scene: Counted are scenes of the default hierarchy without instances.
        resident: How it is kept.
    """
    if scene.hierarchy is not None or scene.instances is not None or scene.block_count == 0:
        return None
    packed = scene.with_boxes()
    assert packed.runs is not None
    assert packed.first_run is not None
    if resident == "expanded":
        faces = scene.triangle_count if scene.remap is None else int(scene.remap.face.max()) + 1
        kept = RUN_BYTES * size_class(len(packed.runs)) + NODE_BYTES * size_class(len(packed.nodes) + 1)
        return kept + FACE_BYTES * faces
    stored = scene.packed.runs is not None

    def room(count: int) -> int:
        return count if stored else size_class(count, COMPRESSED_STEPS)

    kept = traced_bytes(scene.blocks, packed, room)
    if scene.remap is not None:
        kept += scene.remap.face[:1].nbytes * room(len(scene.remap.face)) + scene.remap.rotation.nbytes
    return kept


def traced_bytes(blocks: "Blocks", packed: "PackedNodes", room: Callable[[int], int] = int) -> int:
    """What a tracer keeps of nodes and blocks without unpacking them.

    Args:
        blocks: The blocks.
        packed: All nodes.
        room: How many there is room for, where there are so many.
    """
    of_nodes = (NODE_RECORD_BYTES + SLOTS_BYTES) * room(len(packed.nodes))
    of_blocks = BLOCK_BYTES * (room(BLOCK_WORDS * blocks.count) // BLOCK_WORDS)
    return of_nodes + of_blocks + WORD_BYTES * room(len(blocks.words))
