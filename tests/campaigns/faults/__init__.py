"""The fault campaign: the whole daemon on virtual time, with whatever can go wrong, again and again."""
