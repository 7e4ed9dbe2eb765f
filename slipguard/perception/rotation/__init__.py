"""The rotation of a contact since the reference, with its sigma, or the reason why there is none."""
