"""The named ways of augmenting that the benchmark compares: an augmenter and which estimates see its episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from oat_gym.augmenters import AUGMENTERS, OAT, TDA, Augmenter, Jittering, TimeGAN
from oat_gym.augmenters.compose import Compose
from oat_gym.errors import ConfigurationError
from oat_gym.generation import BehaviorConfig, VAEMDPConfig
from oat_gym.generation.timegan import TimeGANConfig
from oat_gym.generation.vae import VAEConfig
from oat_gym.mining import MiningConfig
from oat_gym.ope import Policy, UseAugmented
from oat_gym.ope.policy import PolicySet
from oat_gym.spaces import Batch, map_tree, tree_length

FloatArray = npt.NDArray[np.float64]

NONE = "none"
"""The variant that augments nothing: what all others are compared with."""


@dataclass(frozen=True)
class Variant:
    """One row of the tables.

    Args:
        name: of the row.
        augmenter: the method with its settings; None augments nothing.
        factor: episodes in all, as a multiple of the source's.
        use_augmented: what synthetic episodes are used for (`ope.evaluate`): "all" is the paper's way, None uses them
            for training only, so that importance weights and initial states stay real.
        paper: the row of the paper's tables that this one repeats, "" for none.
        targets: in roll-outs the target policies act (one of them, drawn anew for each step), not the clone.
        note: one line that says what it is.
        revision: of the method's code. Raise it when a change alters what is generated from the same settings: cells of
            before are then computed again.

    >>> find_variant("jittering").use_augmented, find_variant("jittering+training").use_augmented
    ('all', None)
    """

    name: str
    augmenter: Augmenter | None
    factor: float = 10
    use_augmented: UseAugmented = "all"
    paper: str = ""
    targets: bool = False
    note: str = ""
    revision: int = 0

    def __post_init__(self) -> None:
        if (self.augmenter is None) != (self.name == NONE):
            raise ConfigurationError(f"Only the variant {NONE!r} has no augmenter, got {self!r}.")
        if self.augmenter is not None and not self.factor > 1:
            raise ConfigurationError(f"factor must be more than 1, got {self.factor!r}.")
        if self.targets and not isinstance(self.augmenter, OAT):
            raise ConfigurationError(f"targets is of OAT, which rolls out policies, got {self!r}.")

    def with_policies(self, policies: Mapping[str, Policy]) -> Augmenter | None:
        """Return the augmenter for a task's target policies."""
        if not self.targets or not isinstance(self.augmenter, OAT):
            return self.augmenter
        return replace(self.augmenter, policy=AnyTarget(PolicySet.of(policies)))

    def description(self) -> dict[str, Any]:
        """Return what identifies it: all but the name, the note and the paper's row."""
        if self.augmenter is None:
            return {"augmenter": None}
        described = {"augmenter": self.augmenter, "factor": float(self.factor), "use_augmented": self.use_augmented}
        described |= {"targets": True} if self.targets else {}
        return described | ({"revision": self.revision} if self.revision else {})


@dataclass(frozen=True)
class AnyTarget:
    """One of several policies, drawn anew for each observation."""

    policies: PolicySet

    def sample(self, observations: Batch, *, rng: np.random.Generator) -> Batch:
        """Return n actions."""
        drawn = self.policies.sample(observations, rng=rng)
        n = tree_length(observations)
        chosen = rng.integers(len(self.policies), size=n)
        return map_tree(lambda leaf: leaf[chosen, np.arange(n)], drawn)

    def log_prob(self, observations: Batch, actions: Batch) -> FloatArray:
        """Return the log of the mean density, (n,)."""
        each = self.policies.log_prob(observations, actions)
        return np.asarray(np.logaddexp.reduce(each, axis=0) - np.log(len(self.policies)))


def _baseline(name: str, paper: str) -> Variant:
    return Variant(name, AUGMENTERS[name](), paper=paper, note=f"{paper} with its authors' settings")


_MANY = MiningConfig(n_clusters="auto", top=20)
_PRIOR = OAT(start="prior", seam="contiguous", observation_noise=True)
"""OAT where the paper says how a roll-out starts, what it draws and which sample is taken."""
_POSTERIOR = replace(_PRIOR, start="posterior")
_MATCHED = replace(_POSTERIOR, seam="matched")
_RANDOM = TDA(start="prior", seam="contiguous", observation_noise=True, ends="generated")

VARIANTS: dict[str, Variant] = {
    variant.name: variant
    for variant in (
        Variant(NONE, None, paper="NoAug.", note="the recorded episodes alone"),
        Variant("oat", OAT(), use_augmented=None, note="OAT with this library's defaults, for training only"),
        Variant("oat-paper", OAT.preset("paper"), paper="OAT", note="OAT as the paper has it, for every estimate"),
        _baseline("vae-mdp", "VAE-MDP"),
        _baseline("timegan", "TimeGAN"),
        _baseline("vae", "VAE"),
        _baseline("spawner", "SPAWNER"),
        _baseline("dgw", "DGW"),
        _baseline("permutation", "Permutation"),
        _baseline("jittering", "Jittering"),
        _baseline("scaling", "Scaling"),
        Variant("tda", _RANDOM, paper="TDA", note="TDA: windows anywhere, ends of episodes included"),
        Variant(
            "oat-prior",
            _PRIOR,
            use_augmented=None,
            note="OAT with roll-outs from the prior, one sample a span and noisy steps",
        ),
        Variant(
            "oat-posterior",
            _POSTERIOR,
            use_augmented=None,
            note="as oat-prior, roll-outs start where the span that they replace starts",
        ),
        Variant(
            "oat-matched",
            _MATCHED,
            use_augmented=None,
            note="as oat-posterior, the best of several samples at the seams",
        ),
        Variant(
            "oat-many",
            OAT(mining=_MANY),
            use_augmented=None,
            note="as oat, 20 sets of sub-trajectories in place of one",
        ),
        Variant(
            "oat-recorded",
            OAT(mining=_MANY, actions="recorded"),
            use_augmented=None,
            note="as oat-many, the recorded actions replayed in the model",
        ),
        Variant(
            "oat-targets",
            OAT(mining=_MANY),
            use_augmented=None,
            targets=True,
            note="as oat-many, and the target policies act in the model in place of the clone",
        ),
        Variant(
            "oat-light",
            _MATCHED,
            factor=2,
            use_augmented=None,
            note="as oat-matched, one synthetic episode for each real one: synthetic steps weigh half",
        ),
        Variant(
            "oat-cut",
            replace(_PRIOR, ends="generated"),
            use_augmented=None,
            note="as oat-prior, and spans may hold the step in which an episode terminates, as in the paper",
        ),
        Variant(
            "oat-kept",
            OAT(rewards="recorded"),
            use_augmented=None,
            note="as oat, with rewards that the data holds",
        ),
        Variant(
            "oat-jitter",
            Compose((OAT(), Jittering())),
            use_augmented=None,
            note="as oat, then jittering: regularisation by noise of one size everywhere",
        ),
    )
}
"""Every variant by name."""

ALL = tuple(VARIANTS)[:12]
"""What `--augmenters all` means: no augmentation, OAT in both forms, and the paper's nine other methods."""

_USES: dict[str, UseAugmented] = {"training": None, "all": "all"}


def find_variant(name: str) -> Variant:
    """Return a variant by name; NAME+training or NAME+all changes what its synthetic episodes are used for.

    Raises:
        ConfigurationError: for an unknown name.
    """
    base, plus, use = name.partition("+")
    if base not in VARIANTS or (plus and (use not in _USES or base == NONE)):
        raise ConfigurationError(
            f"There is no variant {name!r}; choose of {', '.join(VARIANTS)}, each but {NONE} also with "
            f"{' or '.join('+' + key for key in _USES)} behind it."
        )
    variant = VARIANTS[base]
    return replace(variant, name=name, use_augmented=_USES[use], paper="") if plus else variant


def parse_variants(names: str) -> tuple[Variant, ...]:
    """Return the variants of a list like "all" or "oat,jittering"; `none`, the comparison, is always among them.

    Raises:
        ConfigurationError: for an unknown or a repeated name.
    """
    wanted = [part for name in names.split(",") for part in (ALL if name.strip() == "all" else (name.strip(),))]
    if len(set(wanted)) < len(wanted):
        raise ConfigurationError(f"--augmenters names a variant twice: {names!r}.")
    return tuple(find_variant(name) for name in dict.fromkeys((NONE, *wanted)))


def quick_augmenter(augmenter: Augmenter) -> Augmenter:
    """Return the same method trained for a moment: at most 60 updates, ten clusters and no search for their number."""
    if isinstance(augmenter, TimeGAN):
        small = replace(augmenter.model, embedding_iterations=20, supervised_iterations=10, joint_iterations=10)
        return replace(augmenter, model=small)
    return _replace_fields(augmenter, _quick_part)


def on_device(augmenter: Augmenter, device: str) -> Augmenter:
    """Return the same method with every network on a torch device."""

    def moved(part: Any) -> Any:
        if isinstance(part, VAEMDPConfig | VAEConfig | BehaviorConfig | TimeGANConfig):
            return replace(part, device=device)
        return part

    return _replace_fields(augmenter, moved)


def fit_length(augmenter: Augmenter, lengths: npt.NDArray[np.int64]) -> Augmenter:
    """Return OAT or TDA with sub-trajectories that fit into a dataset's episodes.

    W stays as it is (20 in the paper) where at least half of the episodes have 1.25 W steps; elsewhere it becomes half
    of the median length (at least 2). Other methods are returned as they are.
    """
    if isinstance(augmenter, Compose):
        return Compose(tuple(fit_length(part, lengths) for part in augmenter.augmenters))
    median = float(np.median(lengths))

    def fitting(width: object) -> int | None:
        return max(2, int(median // 2)) if isinstance(width, int) and median < 1.25 * width else None

    if isinstance(augmenter, OAT):
        width = fitting(augmenter.mining.length)
        return augmenter if width is None else replace(augmenter, mining=replace(augmenter.mining, length=width))
    if isinstance(augmenter, TDA):
        width = fitting(augmenter.length)
        return augmenter if width is None else replace(augmenter, length=width)
    return augmenter


def _quick_part(part: Any) -> Any:
    if isinstance(part, VAEMDPConfig):
        return replace(part, max_updates=min(60, part.max_updates), learning_rate_grid=None)
    if isinstance(part, VAEConfig | BehaviorConfig):
        return replace(part, max_updates=60)
    if isinstance(part, MiningConfig):
        return replace(part, n_clusters=10, max_iterations=15)
    return part


def _replace_fields(augmenter: Augmenter, change: Callable[[Any], Any]) -> Augmenter:
    if isinstance(augmenter, Compose):
        return Compose(tuple(_replace_fields(part, change) for part in augmenter.augmenters))
    parts = {field.name: getattr(augmenter, field.name) for field in fields(augmenter) if field.init}
    changed = {name: change(part) for name, part in parts.items()}
    return replace(augmenter, **{name: part for name, part in changed.items() if part is not parts[name]})
