"""DTW against tslearn in one run: median CPU time of a call on two n x n x D series, and the ratio.

    python tests/benchmarks/bench_dtw.py [--rows 200] [--features 68] [--repeats 100]

Both sides are compiled by a first call that is not counted, and called in turn, so that a change of the machine's
speed meets both. Distances must agree, or nothing is printed.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import numpy as np
from tslearn.metrics import dtw as peer_dtw
from tslearn.metrics import dtw_path as peer_dtw_path

from oat_gym.dtw import dtw, dtw_path


def seconds(call: Callable[[], object]) -> float:
    """CPU time of one call."""
    begin = time.process_time()
    call()
    return time.process_time() - begin


def main() -> None:
    """Print a markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=200)
    parser.add_argument("--features", type=int, default=68)
    parser.add_argument("--repeats", type=int, default=100)
    args = parser.parse_args()
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, args.rows, args.features))
    radius = args.rows // 10
    band = {"global_constraint": "sakoe_chiba", "sakoe_chiba_radius": radius}
    cases: dict[str, tuple[Callable[[], object], Callable[[], object]]] = {
        "distance": (lambda: dtw(x, y), lambda: peer_dtw(x, y)),
        "path": (lambda: dtw_path(x, y)[1], lambda: peer_dtw_path(x, y)[1]),
        f"path, band {radius}": (lambda: dtw_path(x, y, radius=radius)[1], lambda: peer_dtw_path(x, y, **band)[1]),
    }
    print(f"{args.rows} x {args.rows} x {args.features}, median of {args.repeats} calls\n")
    print("| what | oat_gym ms | tslearn ms | ratio |\n|---|---|---|---|")
    for name, (ours, peer) in cases.items():
        np.testing.assert_allclose(ours(), peer(), rtol=1e-12)
        pairs = [(seconds(ours), seconds(peer)) for _ in range(args.repeats)]
        mine, theirs = (1e3 * statistics.median(column) for column in zip(*pairs, strict=True))
        print(f"| {name} | {mine:.3f} | {theirs:.3f} | {theirs / mine:.1f} |")


if __name__ == "__main__":
    main()
