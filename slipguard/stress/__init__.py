"""Numerical stability of all that lies between a gel frame and the object's turn: families of trials, and their run."""
