"""From a gel frame to a signed turn with its uncertainty: pure functions on arrays."""
