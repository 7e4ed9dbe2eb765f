"""Torn frames: how many are found, whether good ones are taken for torn, and what undetected ones cost."""
