"""Rows of metrics.jsonl: the PSNR of training photographs."""

from collections.abc import Sequence
from typing import Any


def of_final_size(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Lines of metrics.jsonl with photographs as large as in the last one; others are not comparable."""
    times = [row.get("statistics", {}).get("reduction", 1.0) for row in rows]
    return [row for row, reduction in zip(rows, times, strict=True) if reduction == times[-1]]


def last_psnr(rows: Sequence[dict[str, Any]]) -> float | None:
    """PSNR of training photographs in dB, its mean over the last quarter of training, at full size; else None."""
    found = [(row["step"], row["psnr"]) for row in of_final_size(rows) if "psnr" in row]
    last = [psnr for step, psnr in found if step > 3 / 4 * found[-1][0]]
    return sum(last) / len(last) if last else None
