"""The paper's domains: datasets by name.

>>> from oat_gym import domains
>>> domains.load("maze2d-umaze").total_episodes
250
"""

from collections.abc import Callable

import minari

from oat_gym.domains import adroit, maze2d, tutoring
from oat_gym.errors import ConfigurationError

DATASETS: dict[str, Callable[[], minari.MinariDataset]] = {
    "maze2d-umaze": maze2d.umaze,
    "adroit-door-human": adroit.door_human,
    "tutoring-smartprimer": tutoring.smartprimer,
}
"""Name of each dataset and the function that opens it."""


def load(name: str) -> minari.MinariDataset:
    """Return the dataset of this name (one of `DATASETS`) as an ordinary Minari dataset.

    Raises:
        ConfigurationError: for an unknown name.
        DatasetNotFoundError: if the data is not on this machine; the message says how to get it.
    """
    if name not in DATASETS:
        raise ConfigurationError(f"There is no dataset named {name!r}; the names are {', '.join(sorted(DATASETS))}.")
    return DATASETS[name]()


__all__ = ["DATASETS", "adroit", "load", "maze2d", "tutoring"]
