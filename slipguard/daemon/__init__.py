"""The running guard: event loop, workers, local API."""
