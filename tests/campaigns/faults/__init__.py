"""The fault campaign: the whole daemon on virtual time, with random faults, many times."""
