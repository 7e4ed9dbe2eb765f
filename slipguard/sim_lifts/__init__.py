"""`slipguard --sim`: the daemon with simulated devices, one lift per object, compared with the truth."""
