"""Requests to the daemon and answers from it: handlers, snapshot, client, paths."""
