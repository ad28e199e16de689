"""The operations of `lanes` in NumPy, for an engine that runs without Numba. Index arrays rather than slices, because
NumPy checks these."""

from __future__ import annotations

import numpy as np

from .lanes import BLOCK as BLOCK
from .lanes import TILE as TILE

ALONG = np.arange(BLOCK)


def _rows(first, count):
    """Where `count` rows of a buffer lie, from row `first` on."""
    return (first + np.arange(count))[:, None] * BLOCK + ALONG


def move(source, start, target, to):
    target.reshape(-1)[to + ALONG] = source.reshape(-1)[start + ALONG]


def transpose(buffer, source, target):
    buffer[_rows(target, BLOCK)] = buffer[_rows(source, BLOCK)].T


def _tile(finish):
    def tile(inputs, first_input, depth, weights, first_weight, down, across, outputs, first_output, first_gate, lanes):
        outward, inward = np.arange(len(lanes)), np.arange(depth)
        w = weights[first_weight + across * outward[:, None] + down * inward]
        gate = outputs[_rows(first_gate, len(lanes))]
        outputs[_rows(first_output, len(lanes))] = finish(w @ inputs[_rows(first_input, depth)], gate)

    return tile


product = _tile(lambda total, gate: total)
rectified = _tile(lambda total, gate: np.where(total > 0, total, 0))
gated = _tile(lambda total, gate: np.where(gate > 0, total, 0))
added = _tile(lambda total, gate: total + gate)
