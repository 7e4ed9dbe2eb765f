"""Makes the helper modules of this folder importable from the test folders below it."""
