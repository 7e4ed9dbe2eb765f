"""The daemon's local API, as seen from the loop: requests, their handlers, the state snapshot, and a client."""
