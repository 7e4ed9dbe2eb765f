"""Tests of numerical stability: a table of perturbations, applied to the same grasps."""
