"""Simulators of the paper's human-involved tasks: `oat_gym/Sepsis-v0` and `oat_gym/Tutor-v0` of Gymnasium.

>>> import gymnasium
>>> gymnasium.make_vec("oat_gym/Tutor-v0", num_envs=3).single_action_space
Discrete(3)
"""

import gymnasium as gym

SEPSIS_ID = "oat_gym/Sepsis-v0"
TUTOR_ID = "oat_gym/Tutor-v0"


def register() -> None:
    """Make both environments known to Gymnasium; calling it again changes nothing."""
    for name, module, entry in ((SEPSIS_ID, "sepsis", "Sepsis"), (TUTOR_ID, "tutor", "Tutor")):
        if name not in gym.registry:
            gym.register(
                name,
                entry_point=f"oat_gym.envs.{module}:{entry}Env",
                vector_entry_point=f"oat_gym.envs.{module}:{entry}VectorEnv",
            )


__all__ = ["SEPSIS_ID", "TUTOR_ID", "register"]
