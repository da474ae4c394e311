"""Spaces of `oat_gym/Sepsis-v0`: those of the real visits, and the treatments in effect."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces

from oat_gym.domains.sepsis_attributes import HIGH, LOW, NAMES

OBSERVATION_SPACE = spaces.Dict(
    recorded=spaces.MultiBinary(len(NAMES)),
    treatments=spaces.MultiBinary(2),
    values=spaces.Box(LOW.astype(np.float32), HIGH.astype(np.float32), dtype=np.float32),
)
"""`values`: what is believed of each attribute (`sepsis_belief`); `recorded`: 1 where it was measured at this event;
`treatments`: whether antibiotics and oxygen assistance are in effect, which clinicians know when they decide."""

ACTION_SPACE = spaces.Discrete(4)
"""antibiotics + 2 * oxygen, in effect until the next event."""
