"""TICC against fast-ticc 1.1.0: CPU time of the fit and the objective reached, from the same initial labels.

    python tests/benchmarks/bench_ticc.py --peer-python PYTHON [--npz FILE] [--rows 6650] [--window 3]

PYTHON is an interpreter where `fast-ticc==1.1.0` is installed; by default this one. FILE is an .npz with
`observations` (n, D); without it, data with planted regimes is generated. Both sides get the same z-scored rows as
one series, one BLAS thread, and a warm-up fit first, so that compilation is not counted. CPU time is of the fit
alone, child processes included. Both results are scored by the objective that `oat_gym.mining.TICC` documents, on
the windows that both sides have in full.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
for _name in THREADS:
    os.environ[_name] = "1"

import numpy as np  # noqa: E402 - after the thread limits


def cpu_seconds() -> float:
    """CPU time of this process and of its ended children."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def planted(rows: int, features: int, clusters: int, seed: int) -> np.ndarray:
    """Regimes of 20-120 rows with their own mean, correlation and smoothness."""
    rng = np.random.default_rng(seed)
    mixing = rng.normal(size=(clusters, features, features)) / np.sqrt(features)
    means = rng.normal(scale=0.7, size=(clusters, features))
    parts: list[np.ndarray] = []
    while sum(map(len, parts)) < rows:
        k = int(rng.integers(clusters))
        noise = rng.normal(size=(int(rng.integers(20, 120)), features))
        noise[1:] = 0.8 * noise[1:] + 0.6 * noise[:-1]
        parts.append(means[k] + noise @ mixing[k] + 0.3 * rng.normal(size=noise.shape))
    return np.concatenate(parts)[:rows]


def run_peer(folder: Path, *, window: int, clusters: int, penalty: float, sparsity: float, limit: int) -> None:
    """Fit fast-ticc on folder/x.npy from folder/labels.npy; write folder/peer.npz."""
    import fast_ticc
    from fast_ticc import cluster_label_assignment

    x, labels = np.load(folder / "x.npy"), np.load(folder / "labels.npy")
    settings = {"window_size": window, "label_switching_cost": penalty, "sparsity_weight": sparsity}
    with contextlib.redirect_stdout(sys.stderr):
        fast_ticc.ticc_labels(x[:400, :3], num_clusters=2, iteration_limit=2, **settings)
    count = len(x) - window + 1  # window t of fast-ticc is rows t..t+window-1; ours ends at its row
    cluster_label_assignment.build_initial_clusters = lambda *_: [int(k) for k in labels[-count:]]
    begin = cpu_seconds()
    with contextlib.redirect_stdout(sys.stderr):
        model = fast_ticc.ticc_labels(x, num_clusters=clusters, iteration_limit=limit, **settings)
    seconds = cpu_seconds() - begin
    found = np.asarray(model.point_labels)
    np.savez(
        folder / "peer.npz",
        seconds=seconds,
        labels=found[found >= 0],
        means=np.stack(model.trained_model.per_cluster_mean),
        precisions=np.stack(model.markov_random_fields),
    )


def run_ours(
    x: np.ndarray, labels: np.ndarray, *, window: int, clusters: int, penalty: float, sparsity: float, limit: int
) -> dict[str, object]:
    """Fit TICC after a warm-up; returns seconds, labels, means and precisions."""
    from oat_gym.mining import TICC

    TICC(2, window).fit([x[:400, :3]])
    # Without times a switch costs switch_penalty / log(e + 1); the peer's costs exactly `penalty`.
    switch_penalty = penalty * float(np.log(np.e + 1))
    model = TICC(clusters, window, sparsity, switch_penalty, [labels], standardize=False, max_iterations=limit)
    begin = cpu_seconds()
    model.fit([x])
    seconds = cpu_seconds() - begin
    result: dict[str, object] = {"seconds": seconds, "labels": model.labels_[0][window - 1 :]}
    return result | {"means": model.means_, "precisions": model.precisions_, "iterations": model.n_iter_}


def score(x: np.ndarray, result: dict[str, object], window: int, penalty: float, sparsity: float) -> dict[str, float]:
    """The objective of `TICC` on the full windows (at the peer's penalty), its parts, and with the sparsity term."""
    labels, means, precisions = (np.asarray(result[k]) for k in ("labels", "means", "precisions"))
    windows = np.concatenate([x[lag : len(x) - window + 1 + lag] for lag in range(window)], axis=1)
    likelihood = size = 0.0
    for k in np.unique(labels):
        centred = windows[labels == k] - means[k]
        log_det = np.linalg.slogdet(precisions[k])[1]
        square = np.einsum("ij,jk,ik->i", centred, precisions[k], centred, optimize=True).sum()
        likelihood += 0.5 * (len(centred) * (log_det - windows.shape[1] * np.log(2 * np.pi)) - square)
        size += 0.5 * sparsity * len(centred) * np.abs(precisions[k]).sum()
    switches = float((np.diff(labels) != 0).sum())
    return {
        "objective": likelihood - penalty * switches,
        "log_likelihood": likelihood,
        "with_sparsity": likelihood - size - penalty * switches,
        "switches": switches,
    }


def main() -> None:
    """Run both sides and print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peer-python", default=sys.executable)
    parser.add_argument("--npz", type=Path)
    parser.add_argument("--rows", type=int, default=6650)
    parser.add_argument("--features", type=int, default=39, help="of generated data")
    parser.add_argument("--window", type=int, default=3)
    parser.add_argument("--clusters", type=int, default=10)
    parser.add_argument("--penalty", type=float, default=100.0)
    parser.add_argument("--sparsity", type=float, default=0.11)
    parser.add_argument("--iterations", type=int, default=100, help="limit for both sides; the peer can cycle for ever")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ours-only", action="store_true")
    parser.add_argument("--peer-folder", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    settings = {"window": args.window, "clusters": args.clusters, "penalty": args.penalty}
    settings |= {"sparsity": args.sparsity, "limit": args.iterations}
    if args.peer_folder:
        run_peer(args.peer_folder, **settings)
        return
    from oat_gym.mining._initial import kmeans_labels
    from oat_gym.mining._windows import join_series, standardisation

    raw = np.load(args.npz)["observations"] if args.npz else planted(args.rows, args.features, args.clusters, args.seed)
    rows = join_series([raw[: args.rows]])
    center, scale = standardisation(rows.values)
    x = (rows.values - center) / scale
    labels = kmeans_labels(join_series([x]), n_clusters=args.clusters, seed=args.seed)
    ours = run_ours(x, labels, **settings)
    report: dict[str, object] = {
        "rows": len(x),
        "features": x.shape[1],
        "window": args.window,
        "cpu_s": ours["seconds"],
    }
    report |= {"iterations": ours["iterations"], "ours": score(x, ours, args.window, args.penalty, args.sparsity)}
    if not args.ours_only:
        with tempfile.TemporaryDirectory() as name:
            np.save(Path(name) / "x.npy", x)
            np.save(Path(name) / "labels.npy", labels)
            command = [args.peer_python, __file__, *sys.argv[1:], "--peer-folder", name]
            environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
            subprocess.run(command, check=True, env=environment)
            peer = dict(np.load(Path(name) / "peer.npz"))
        report |= {
            "peer_cpu_s": float(peer["seconds"]),
            "cpu_ratio": float(peer["seconds"]) / float(str(ours["seconds"])),
        }
        report["peer"] = score(x, peer, args.window, args.penalty, args.sparsity)
        report["label_agreement"] = float(np.mean(np.asarray(ours["labels"]) == peer["labels"]))
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
