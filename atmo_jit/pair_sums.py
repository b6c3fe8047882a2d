"""Light that scatters toward a direction: sums over pairs (l, m) of harmonics, phase moments and moments of light."""

from __future__ import annotations

from typing import Any

import drjit as dr

from .backend import packet, padded, row, types
from .harmonics import Harmonics, pair_count


def sums_of_pairs(
    degree: int,
    counts: tuple[int, int],
    parts: list[tuple[list[Any], list[list[Any]]]],
    basis: Harmonics,
    moments: Any,
    phases: Any,
    recurrences: Any,
    active: Any,
) -> list[list[Any]]:
    """For each of the ``parts``, nodes and their weights per channel, the sum over pairs up to a degree: of
    [scatterer x channel], without derivatives.

    ``counts``: channels, scatterers. ``moments``, ``phases``, ``recurrences``: tables of field.Field.
    """
    t, width, (channels, kinds) = types(), dr.width(parts[0][0][0]), counts
    size, several, stride = padded(channels), len(parts) > 1, dr.opaque(t.UInt, pair_count(degree), 1)

    def pair(i: Any, state: Any, sums: list[list[Any]]) -> tuple[Any, ...]:
        (value,), state = basis.next(packet(recurrences, i, 4, active), state)
        chi = row(phases, i, kinds * channels, active=active)
        new = []
        for (nodes, weights), old in zip(parts, sums, strict=True):
            corner = [packet(moments, node * stride + i, size, active, alone=several) for node in nodes]
            moment = [_blend([w[c] for w in weights], [v[c] for v in corner]) for c in range(channels)]
            new.append([dr.fma(value, chi[n] * moment[n % channels], s) for n, s in enumerate(old)])
        return i + 1, state, new

    sums = [[dr.zeros(t.Float, width) for _ in range(kinds * channels)] for _ in parts]
    state = (t.UInt(0), basis.start(width), sums)
    return dr.while_loop(state, lambda i, *_: i < stride, pair, label="slopes" if several else "scattered")[-1]


def _blend(weights: list[Any], values: list[Any]) -> Any:
    total = weights[0] * values[0]
    for weight, value in zip(weights[1:], values[1:], strict=True):
        total = dr.fma(weight, value, total)
    return total
