"""Training and export of segmentation networks. Needs the `train` extra."""
