"""Augment the embedded maze dataset, look at what was mined, and save the result as a Minari dataset.

The settings are small so that this runs in seconds; leave `mining` and `model` out for the defaults.
"""

import os
import tempfile

import oat_gym
from oat_gym import OAT, MiningConfig
from oat_gym.generation import BehaviorConfig, VAEMDPConfig

real = oat_gym.domains.load("maze2d-umaze")
config = OAT(
    mining=MiningConfig(n_clusters=5, length=15, top=2, switch_penalty=20.0, init="kmeans"),
    model=VAEMDPConfig(max_updates=50),
    behavior=BehaviorConfig(max_updates=200),
    features=("achieved_goal",),
)
data = oat_gym.AugmentedDataset(real, config, factor=3, seed=0)
print(f"{len(data)} episodes and {data.total_steps} steps, before any training")

data.fit()
print(data.mining)

origin = data.provenance(len(real) + 3)
print(f"episode {len(real) + 3} is episode {origin.source} with generated spans {origin.spans}")

columns = data.transitions()
print(f"{len(columns)} transitions, {columns.synthetic.mean():.1%} of them generated")

# A temporary folder, only for this example: your own Minari datasets are where `save` otherwise writes.
with tempfile.TemporaryDirectory() as folder:
    os.environ["MINARI_DATASETS_PATH"] = folder
    saved = data.save("example/maze-oat-v0")
    print(f"saved {len(saved)} episodes as {saved.id}")
