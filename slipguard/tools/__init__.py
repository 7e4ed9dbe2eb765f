"""Offline tools: measure images, replay recordings, plots, parallel work."""
