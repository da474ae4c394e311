"""What is measured: the scores of one augmented dataset, and what each of them means."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from oat_gym.errors import ConfigurationError

Better = Literal["lower", "higher", "near reference"]


@dataclass(frozen=True)
class Score:
    """A number for the generated steps, and the same number for real steps in their place.

    `value` is None where the method has nothing to measure (no seams), or too little data is there. `reference` is
    what real episodes give: half of them (in the place of the generated ones) against the other half. Generated data
    is as good as new real data where the two are equal.
    """

    value: float | None
    reference: float | None


@dataclass(frozen=True)
class Fidelity:
    """How like the real data the generated steps of a dataset are; `METRICS` says it again for tables and pictures.

    "sd" is a standard deviation of the real data; one-hot columns count as they are. Coverage, distances, roughness,
    dynamics and the classifier compare with the real steps in whose place the others were generated: of a stitching
    method those that its spans replace, so that methods that generate parts of episodes are not blamed for the rest
    (all steps where these are of fewer than 4 episodes). Memorisation and seams compare with all real steps.
    Coverage, distances and roughness are the mean over the two halves of the real episodes.

    Attributes:
        n_real: number of real steps.
        n_generated: number of generated steps, of which all or a sample (`limit`) are measured.
        coverage_gained: share (0 to 1) of generated (s, a) that lie in no cell of the real ones: new ground. Higher
            is more; it is good only where `dynamics` stays near 1.
        coverage_lost: share (0 to 1) of the cells of real (s, a) without a generated point. Lower is better.
        marginal: mean over the columns of (s, a, r, s') of the 1-Wasserstein distance, sd. Lower is better.
        sliced: sliced 2-Wasserstein distance of (s, a, r, s'), sd. Lower is better.
        mmd: squared maximum mean discrepancy of (s, a, r, s'), unbiased: about 0 (may be below) to 2. Lower is better.
        dynamics: error of the generated changes s' - s against a model fitted to real steps, relative to the error of
            held-out real steps (ratio). 1: as predictable as real data; higher: other dynamics, or noise.
        reward: the same for rewards (ratio).
        roughness: mean size of s' - s relative to real steps (ratio). Over 1: jitter; under 1: smoothed.
        seam_mean: mean jump where a generated span meets recorded steps, sd (root mean square over the features).
            Lower is better; the reference is the mean size of a real step. None without seams.
        seam_p95: the 95th percentile of these jumps, sd; the reference is that of real steps.
        discriminative: |accuracy - 1/2| of a classifier that tells generated from real steps, 0 to 1/2. Lower is
            better. None where the generated steps come from one episode only.
        memorised: share (0 to 1) of generated steps that lie closer to a real step than the median real step lies to
            one of another episode. Reference 1/2: more is closer to the data than new episodes would be.
        nearest: median distance to the nearest real step, relative to that of real steps to other episodes (ratio).
            Near 0: copies; over 1: farther from the data than new episodes would be.
        copies: share (0 to 1) of generated steps that are a real step to the last bit. Lower is better; the reference
            is the share of real steps that are found in another episode too.
    """

    n_real: int
    n_generated: int
    coverage_gained: Score
    coverage_lost: Score
    marginal: Score
    sliced: Score
    mmd: Score
    dynamics: Score
    reward: Score
    roughness: Score
    seam_mean: Score
    seam_p95: Score
    discriminative: Score
    memorised: Score
    nearest: Score
    copies: Score

    def score(self, name: str) -> Score:
        """Return the score of a metric's name; `ConfigurationError` for any other name."""
        if name not in METRICS:
            raise ConfigurationError(f"There is no metric {name!r}; choose one of {', '.join(METRICS)}.")
        return getattr(self, name)

    def to_row(self) -> dict[str, float | int | None]:
        """Return all numbers by name, references as `<name>_reference`: a row of a table."""
        row: dict[str, float | int | None] = {"n_real": self.n_real, "n_generated": self.n_generated}
        for name in METRICS:
            row |= {name: self.score(name).value, f"{name}_reference": self.score(name).reference}
        return row


@dataclass(frozen=True)
class Metric:
    """How to show a metric: a short title, its unit, which direction is better, and what it says, in a few words.

    `limits` are the least and the largest possible value, where there are such.
    """

    title: str
    unit: str
    better: Better
    meaning: str
    limits: tuple[float, float] | None = None


METRICS: dict[str, Metric] = {
    "coverage_gained": Metric("new ground", "share", "higher", "generated (s, a) outside all real cells", (0, 1)),
    "coverage_lost": Metric("ground lost", "share", "lower", "real (s, a) cells without a generated step", (0, 1)),
    "marginal": Metric("marginals", "sd", "lower", "1-Wasserstein distance, mean over columns"),
    "sliced": Metric("sliced distance", "sd", "lower", "sliced 2-Wasserstein distance of (s, a, r, s')"),
    "mmd": Metric("MMD", "squared", "lower", "squared MMD of (s, a, r, s'), unbiased"),
    "dynamics": Metric("dynamics error", "ratio", "near reference", "one-step error of s' relative to real"),
    "reward": Metric("reward error", "ratio", "near reference", "one-step error of r relative to real"),
    "roughness": Metric("roughness", "ratio", "near reference", "mean |s' - s| relative to real"),
    "seam_mean": Metric("seam jump", "sd", "lower", "mean jump at the ends of spans"),
    "seam_p95": Metric("seam jump, 95%", "sd", "lower", "95th percentile of the jumps"),
    "discriminative": Metric(
        "classifier", "|acc. - 1/2|", "lower", "can a classifier tell it from real steps", (0, 0.5)
    ),
    "memorised": Metric("memorised", "share", "near reference", "closer to the data than real episodes are", (0, 1)),
    "nearest": Metric("nearest real step", "ratio", "near reference", "median distance relative to real"),
    "copies": Metric("exact copies", "share", "lower", "equal to a real step to the last bit", (0, 1)),
}
"""Every metric by its attribute of `Fidelity`, in the order of tables and pictures."""
