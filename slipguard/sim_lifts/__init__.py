"""`slipguard --sim`: the daemon on the fakes, one lift per object, compared with the truth."""
