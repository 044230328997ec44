"""Rows of the common form of the benchmarks: what ``bench.py`` gathers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def row(
    stage: str,
    size: str,
    ours_s: float,
    peer: str | None = None,
    peer_s: float | None = None,
    goal: float | None = None,
    accuracy: str | None = None,
    ours_mb: float | None = None,
    peer_mb: float | None = None,
) -> dict[str, Any]:
    """One row. The ratio is that of the seconds, or that of the memory where it is smaller; none without a peer.

    A peer named "limit" is a stated limit of seconds or memory; its goal is 1.
    """
    ratios = [theirs / ours for theirs, ours in ((peer_s, ours_s), (peer_mb, ours_mb)) if theirs is not None and ours is not None]
    return {
        "stage": stage, "size": size, "ours_s": ours_s, "peer": peer, "peer_s": peer_s, "ratio": min(ratios) if ratios else None,
        "goal": 1.0 if peer == "limit" else goal, "ours_mb": ours_mb, "peer_mb": peer_mb, "accuracy": accuracy,
    }  # fmt: skip


def report(rows: list[dict[str, Any]], file: str | None) -> None:
    """Print the rows, and write them as JSON where a file is named."""
    for r in rows:
        theirs = "" if r["peer"] is None else f"; {r['peer']}: not installed"
        if r["peer_s"] is not None:
            theirs = f"; {r['peer']}: {r['peer_s']:.4g} s"
        memory = "" if r["ours_mb"] is None else f", {r['ours_mb']:.0f} MB"
        ratio = "" if r["ratio"] is None else f", ratio {r['ratio']:.1f}"
        print(f"{r['stage']}, {r['size']}: {r['ours_s']:.4g} s{memory}{theirs}{ratio}; {r['accuracy'] or ''}")
    if file:
        Path(file).write_text(json.dumps(rows, indent=1), encoding="utf-8")
