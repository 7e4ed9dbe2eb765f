"""Emulated devices on the wire, written from the vendors' documents. They share no code with the drivers."""
