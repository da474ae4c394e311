"""Mining: TICC labels, the support of label windows, and the sets of potential sub-trajectories (section 2.1)."""

from oat_gym.mining.pst import MiningConfig, MiningResult, PSTSet, mine
from oat_gym.mining.support import TDSSTable, count_tdss, longest_length, support_curve, support_of
from oat_gym.mining.ticc import TICC

__all__ = [
    "TICC",
    "MiningConfig",
    "MiningResult",
    "PSTSet",
    "TDSSTable",
    "count_tdss",
    "longest_length",
    "mine",
    "support_curve",
    "support_of",
]
