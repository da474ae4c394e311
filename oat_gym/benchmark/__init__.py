"""The benchmark of the paper: whether augmentation helps off-policy evaluation, and by how much."""
