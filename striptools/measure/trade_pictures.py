"""How two pictures of one camera differ: PSNR, FLIP where it is installed, and a picture of where.

Source of FLIP: Andersson et al., "FLIP: A Difference Evaluator for Alternating Images" (HPG 2020), by the
package flip-evaluator (extra `flip`), imported only here.
"""

import math
from importlib import import_module
from typing import Any

import numpy as np

from striptools.trace.render import COLD_TO_HOT

MOST_PSNR = 99.0
"""In the place of infinity, for pictures that are the same."""

SHOWN = 0.25
"""The difference, of at most 1, that is drawn hottest."""


def psnr(reference: np.ndarray, picture: np.ndarray) -> float:
    """The peak signal-to-noise ratio in decibels of (h, w, 3) uint8 pictures; 99 where they are the same."""
    square = float(np.mean((reference.astype(np.float64) - picture.astype(np.float64)) ** 2))
    return MOST_PSNR if square == 0 else min(MOST_PSNR, 10 * math.log10(255.0**2 / square))


def flip(reference: np.ndarray, picture: np.ndarray) -> tuple[float, np.ndarray] | None:
    """The mean FLIP error and its map, (h, w) of 0 to 1; None where flip-evaluator is not installed."""
    try:
        evaluate: Any = import_module("flip_evaluator").evaluate
    except ImportError:
        return None
    given = [np.ascontiguousarray(image, np.float32) / np.float32(255) for image in (reference, picture)]
    where, mean, _ = evaluate(*given, "LDR", applyMagma=False)
    return float(mean), np.asarray(where).reshape(reference.shape[0], reference.shape[1], -1)[:, :, 0]


def difference_picture(reference: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """(h, 2w, 3) uint8: the picture, and beside it the largest difference of a channel, hot if large."""
    away = np.abs(reference.astype(np.int16) - picture.astype(np.int16)).max(axis=2) / 255.0
    place = np.minimum(away / SHOWN, 1.0)
    stops = np.linspace(0, 1, len(COLD_TO_HOT))
    heat = np.stack([np.interp(place, stops, column) for column in np.array(COLD_TO_HOT).T], axis=2)
    return np.concatenate([picture, np.rint(heat * 255).astype(np.uint8)], axis=1)
