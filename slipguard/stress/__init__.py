"""Tests of numerical stability from a gel frame to the object's rotation: families of trials, and their runner."""
