"""From what both fingers saw to how hard to hold: pure functions on values."""
