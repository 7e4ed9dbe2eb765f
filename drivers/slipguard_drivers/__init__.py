"""Device drivers of slipguard; each package registers itself through an entry point."""
