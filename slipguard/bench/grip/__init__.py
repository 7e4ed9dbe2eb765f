"""The grip law in closed loop with the simulated cell, beside no guard, a fixed step and one that knows the truth."""
