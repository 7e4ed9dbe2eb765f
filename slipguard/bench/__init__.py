"""Run time against error on this machine: networks, estimators and skips over the same grasps, peers beside them."""
