"""TimeGAN on the sine data of its authors: discriminative and predictive scores of generated series.

    python tests/benchmarks/bench_timegan_sine.py [--samples 10000] [--iterations 50000] [--batch 128] [--seed 0]

Data, scores and settings are those of Yoon et al. (2019) and of the authors' code: 5 features of 24 steps, sin(f t + p)
with f and p uniform in [0, 0.1]; a GRU classifier of real and generated series (score: |accuracy - 0.5| on a held-out
fifth) and a GRU predictor of the last feature's next value, trained on generated series and tested on real ones (score:
mean absolute error). Published for Sines: discriminative .011 (.008), predictive .093 (.019). The row "real" gives the
scores of new real series in the place of generated ones: the best that can be had.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from oat_gym._rng import torch_generator
from oat_gym.generation._gru import gru, gru_shapes, open_gates
from oat_gym.generation._layers import Adam, initial_weights, layer_shapes, linear, one_thread, unpack
from oat_gym.generation.timegan import TimeGANConfig
from oat_gym.generation.timegan_training import fit_timegan

PUBLISHED = {"discriminative": (0.011, 0.008), "predictive": (0.093, 0.019)}

Loss = Callable[[dict[str, Tensor], np.ndarray], Tensor]


def sine_series(count: int, *, length: int = 24, width: int = 5, rng: np.random.Generator) -> np.ndarray:
    """Return (count, length, width) sines in [0, 1]."""
    frequency, phase = (rng.uniform(0, 0.1, size=(count, 1, width)) for _ in range(2))
    return (np.sin(frequency * np.arange(length)[:, None] + phase) + 1) / 2


def discriminative_score(
    real: np.ndarray, generated: np.ndarray, *, rng: np.random.Generator, iterations: int, batch: int = 128
) -> float:
    """Return |accuracy - 0.5| of a GRU classifier on the held-out fifth of both; arrays are (n, length, width)."""
    split = [np.split(rng.permutation(len(part)), [int(0.8 * len(part))]) for part in (real, generated)]
    train = [_tensor(part[rows[0]]) for part, rows in zip((real, generated), split, strict=True)]
    test = [_tensor(part[rows[1]]) for part, rows in zip((real, generated), split, strict=True)]

    def loss(weights: dict[str, Tensor], rows: np.ndarray) -> Tensor:
        x = torch.cat([part[:, rows % part.shape[1]] for part in train], dim=1)
        logits = _last(weights, x)
        signs = torch.cat((torch.ones(len(rows)), -torch.ones(len(rows))))
        return torch.nn.functional.softplus(-signs * logits).mean()

    size = min(part.shape[1] for part in train)
    width = real.shape[2]
    weights = _train(
        loss, size=size, inputs=width, nodes=max(1, width // 2), rng=rng, iterations=iterations, batch=batch
    )
    with torch.no_grad():
        right = torch.cat((_last(weights, test[0]) > 0, _last(weights, test[1]) <= 0))
    return abs(float(right.float().mean()) - 0.5)


def predictive_score(
    real: np.ndarray, generated: np.ndarray, *, rng: np.random.Generator, iterations: int, batch: int = 128
) -> float:
    """Return the mean absolute error, on real series, of a predictor of the last feature's next value.

    It is trained on generated series and sees the other features only; values lie in [0, 1].
    """
    x = _tensor(generated)

    def loss(weights: dict[str, Tensor], rows: np.ndarray) -> Tensor:
        return _prediction_error(weights, x[:, rows])

    size, nodes = len(generated), max(1, real.shape[2] // 2)
    weights = _train(
        loss, size=size, inputs=real.shape[2] - 1, nodes=nodes, rng=rng, iterations=iterations, batch=batch
    )
    with torch.no_grad():
        return float(_prediction_error(weights, _tensor(real)))


def _prediction_error(weights: dict[str, Tensor], x: Tensor) -> Tensor:
    predicted = linear(weights, "out", gru(weights, "net", x[:-1, :, :-1])[None])[0, ..., 0].sigmoid()
    return (predicted - x[1:, :, -1]).abs().mean()


def _last(weights: dict[str, Tensor], x: Tensor) -> Tensor:
    return linear(weights, "out", gru(weights, "net", x)[-1:])[0, :, 0]


def _train(
    loss: Loss, *, size: int, inputs: int, nodes: int, rng: np.random.Generator, iterations: int, batch: int
) -> dict[str, Tensor]:
    shapes = gru_shapes("net", inputs, nodes, 1) | layer_shapes("out", nodes, 1)
    flat = initial_weights(shapes, torch_generator(rng))[None]
    open_gates(unpack(flat, shapes), nodes)
    adam = Adam(flat, torch.tensor([1e-3]), clip=float("inf"))
    for _ in range(iterations):
        flat = flat.requires_grad_()
        value = loss(unpack(flat, shapes), rng.permutation(size)[:batch])
        gradient = torch.autograd.grad(value, flat)[0]
        flat = flat.detach()
        adam.step(flat, gradient)
    return unpack(flat, shapes)


def _tensor(series: np.ndarray) -> Tensor:
    return torch.from_numpy(series.transpose(1, 0, 2).astype(np.float32))


def report(name: str, real: np.ndarray, generated: np.ndarray, *, repeats: int, share: float, seed: int) -> None:
    """Print mean and sd of both scores over `repeats` trainings of the judges, of `share` of the authors' length."""
    scores = {"discriminative": (discriminative_score, 2000), "predictive": (predictive_score, 5000)}
    for what, (score, iterations) in scores.items():
        length = max(1, round(share * iterations))
        values = [
            score(real, generated, rng=np.random.default_rng((seed, r)), iterations=length) for r in range(repeats)
        ]
        mean, spread = PUBLISHED[what]
        print(
            f"{name:<9} {what:<15} {np.mean(values):.4f} (sd {np.std(values):.4f}, {repeats} judges)   "
            f"published {mean} ({spread})",
            flush=True,
        )


def main() -> None:
    """Train, generate, score, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=10_000)
    parser.add_argument(
        "--iterations", type=int, nargs="+", default=[50_000], help="of all phases, or of each of three"
    )
    parser.add_argument("--batch", type=int, default=128)
    parser.add_argument("--learning-rate", type=float, default=1e-3)
    parser.add_argument("--repeats", type=int, default=3, help="trainings of each judge")
    parser.add_argument("--judging", type=float, default=1.0, help="share of the authors' iterations of the judges")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    iterations = arguments.iterations * 3 if len(arguments.iterations) == 1 else arguments.iterations
    config = TimeGANConfig(
        embedding_iterations=iterations[0],
        supervised_iterations=iterations[1],
        joint_iterations=iterations[2],
        batch_size=arguments.batch,
        learning_rate=arguments.learning_rate,
    )
    data_rng, rng = np.random.default_rng((arguments.seed, 1)), np.random.default_rng((arguments.seed, 2))
    real, fresh = (sine_series(arguments.samples, rng=data_rng) for _ in range(2))
    start = time.process_time()

    def progress(phase: str, done: int, total: int) -> None:
        if done % max(1, total // 10) == 0:
            print(f"{phase} {done}/{total}, {time.process_time() - start:.0f} CPU s", file=sys.stderr, flush=True)

    model = fit_timegan(real, config=config, rng=rng, progress=progress)
    print(f"{config}\nsamples {arguments.samples}, seed {arguments.seed}, {time.process_time() - start:.0f} CPU s")
    for name, values in model.history.items():
        print(f"  {name}: first {values[0]:.4f}, last hundredth {values[-max(1, len(values) // 100) :].mean():.4f}")
    generated = model.sample(arguments.samples, rng=rng)
    print(
        f"  mean |difference of means| {np.abs(generated.mean(0) - real.mean(0)).mean():.4f}, of standard deviations "
        f"{np.abs(generated.std(0) - real.std(0)).mean():.4f}",
        flush=True,
    )
    with one_thread():
        report("timegan", real, generated, repeats=arguments.repeats, share=arguments.judging, seed=arguments.seed)
        report("real", real, fresh, repeats=arguments.repeats, share=arguments.judging, seed=arguments.seed)


if __name__ == "__main__":
    main()
